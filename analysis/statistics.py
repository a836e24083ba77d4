"""Means over trials and their intervals, on the exact time grid; no smoothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats

Array = npt.NDArray[np.float64]

LEVEL = 0.95
"""Confidence level of every interval."""

BAND = "95 % t-interval of the mean"
"""Name of the band, printed wherever it is drawn."""


@dataclass(frozen=True)
class Band:
    """A mean over n trials with its interval; each of shape (T,).

    With one trial there is no interval: low and high are NaN. With none, all is NaN.
    """

    mean: Array
    low: Array
    high: Array
    n: int


def standard_error(values: Array) -> Array:
    """Return s/√n along the first axis of (n, ...), NaN for fewer than two."""
    n = len(values)
    if n < 2:
        return np.full(values.shape[1:], np.nan)
    error: Array = np.std(values, axis=0, ddof=1) / np.sqrt(n)
    return error


def mean(values: Array) -> Array:
    """Return the mean along the first axis of (n, ...), NaN for none."""
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    average: Array = np.mean(values, axis=0)
    return average


def mean_band(values: Array, level: float = LEVEL) -> Band:
    """Return mean ± t·SE of trials (n, T), t the two-sided Student quantile of n - 1."""
    centre, n = mean(values), len(values)
    if n < 2:
        nothing = np.full_like(centre, np.nan)
        return Band(centre, nothing, nothing, n)
    half = stats.t.ppf(0.5 + level / 2, n - 1) * standard_error(values)
    return Band(centre, centre - half, centre + half, n)
