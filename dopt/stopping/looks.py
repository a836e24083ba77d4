"""Numbers of seeds after which a stopping rule looks at the results."""

from __future__ import annotations

FEWEST_SEEDS = 10
"""Seeds between two looks at least: a signed-rank test of fewer pairs rejects nothing at levels
below 0.004."""

MOST_LOOKS = 20
"""Looks at most; each one costs time and power."""


def looks(maximum: int) -> list[int]:
    """Return the numbers of seeds at which results are looked at, the last one the maximum.

    They are multiples of ten seeds, or of the smallest multiple of ten that gives at most twenty.
    """
    step = FEWEST_SEEDS * -(-maximum // (FEWEST_SEEDS * MOST_LOOKS))
    return [*range(step, maximum, step), maximum]
