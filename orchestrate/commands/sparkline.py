"""Curve in one line of text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

_BLOCKS = "▁▂▃▄▅▆▇█"


def sparkline(values: Sequence[float | None], columns: int = 60) -> str:
    """Return a positive curve on a logarithmic scale; parts without numbers are spaces.

    Each character is the geometric mean of one part of the values.
    """
    numbers = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    if not np.isfinite(numbers).any():
        return ""
    smallest = np.min(numbers, initial=np.inf, where=numbers > 0)
    logs = np.log(np.maximum(numbers, smallest if np.isfinite(smallest) else 1.0))
    parts = np.array_split(logs, min(columns, len(logs)))
    return "".join(map(_block, _levels(np.array([part.mean() for part in parts]))))


def _levels(heights: npt.NDArray[np.float64]) -> list[float]:
    low, high = np.nanmin(heights, initial=np.inf), np.nanmax(heights, initial=-np.inf)
    span = high - low if high > low else 1.0
    return [float(level) for level in (heights - low) / span * (len(_BLOCKS) - 1)]


def _block(level: float) -> str:
    return _BLOCKS[round(level)] if np.isfinite(level) else " "
