"""Tolerance intervals: what one run does, where an interval of the mean says what they do together.

Distribution-free, by order statistics (Wilks, "Determination of sample sizes for setting tolerance
limits", 1941). Of n independent runs sorted by value, the share of the distribution between the
r-th smallest and the s-th smallest has the distribution Beta(s - r, n - s + r + 1), whatever that
of the runs, if it is continuous.
"""

from __future__ import annotations

import functools
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from analysis.stats.intervals import CONFIDENCE, Band, Statistic, centre

Array = npt.NDArray[np.float64]

CONTENT = 0.9
"""Share of the runs that an interval is to hold."""

FEWEST = 46
"""Runs below which no two of them hold that share with that confidence."""


class BandKind(StrEnum):
    """Kind of interval around a curve: of the centre of the runs, or of single runs."""

    CONFIDENCE = "confidence"
    TOLERANCE = "tolerance"

    def label(self, statistic: Statistic) -> str:
        """Return the name in a caption, beside a centre."""
        if self is BandKind.CONFIDENCE:
            return statistic.band
        return (
            f"tolerance interval, {CONTENT:.0%} of runs with {CONFIDENCE:.0%} confidence".replace(
                "%", " %"
            )
        )


def tolerance_band(values: Array, statistic: Statistic = Statistic.MEAN) -> Band:
    """Return the centre of trials (n, T) and the limits that hold 90 % of runs, at each step.

    Below :data:`FEWEST` trials the limits are NaN.
    """
    n = len(values)
    middle, places = centre(values, statistic), tolerance_places(n)
    if places is None:
        nothing = np.full_like(middle, np.nan)
        return Band(middle, nothing, nothing, n)
    low, high = np.sort(values, axis=0)[list(places)]
    return Band(middle, low, high, n)


@functools.cache
def tolerance_places(n: int) -> tuple[int, int] | None:
    """Return the places, from 0, of the two limits among n sorted runs; None for too few.

    As many runs are left out above as below, and as many as the confidence allows.
    """
    from scipy.special import betainc

    left_out = np.arange(1, (n + 1) // 2)
    inside = n + 1 - 2 * left_out
    confident = 1 - betainc(inside, n + 1 - inside, CONTENT) >= CONFIDENCE
    if not confident.any():
        return None
    most = int(left_out[confident].max())
    return most - 1, n - most
