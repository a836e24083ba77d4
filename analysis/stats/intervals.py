"""Centres of trials and their intervals, on the exact time grid; no smoothing, no sampling of runs.

Three statistics over the trials of a configuration, each with the interval that suits it: the mean
with Student's interval, and the median and the interquartile mean (IQM: the mean of the middle
half; Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", 2021)
with a percentile bootstrap that draws whole trials.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats

Array = npt.NDArray[np.float64]

LEVEL = 0.95
"""Confidence level of every interval."""

RESAMPLES = 1999
"""Draws of a bootstrap band: the 2.5 % quantile is then the 50th smallest."""

_BATCH = 100  # draws at once, which bounds the memory of a curve of 10,000 steps


class Statistic(StrEnum):
    """What a curve shows of its trials at each step."""

    MEAN = "mean"
    MEDIAN = "median"
    IQM = "iqm"

    @property
    def label(self) -> str:
        """Return the name in a caption."""
        return "interquartile mean" if self is Statistic.IQM else str(self)

    @property
    def band(self) -> str:
        """Return the name of the interval, printed wherever it is drawn."""
        kind = "t-interval" if self is Statistic.MEAN else "bootstrap interval"
        return f"95 % {kind} of the {self.label}"


@dataclass(frozen=True)
class Band:
    """A centre over n trials with its interval; each of shape (T,).

    With one trial there is no interval: low and high are NaN. With none, all is NaN.
    """

    centre: Array
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
    return centre(values, Statistic.MEAN)


def centre(values: Array, statistic: Statistic) -> Array:
    """Return a statistic along the first axis of (n, ...), NaN for none."""
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    found: Array = np.asarray(_CENTRES[statistic](values, axis=0))
    return found


def band(values: Array, statistic: Statistic = Statistic.MEAN) -> Band:
    """Return the centre of trials (n, T) at each step, with its 95 % interval.

    Mean: ± t·SE, t the two-sided Student quantile of n - 1. Median and IQM: percentile bootstrap.
    All draws come from a stream of their own, so that the band of the same trials is the same.
    """
    middle, n = centre(values, statistic), len(values)
    if n < 2:
        nothing = np.full_like(middle, np.nan)
        return Band(middle, nothing, nothing, n)
    if statistic is Statistic.MEAN:
        half = stats.t.ppf(0.5 + LEVEL / 2, n - 1) * standard_error(values)
        return Band(middle, middle - half, middle + half, n)
    low, high = _bootstrap(values, statistic)
    return Band(middle, low, high, n)


def _bootstrap(values: Array, statistic: Statistic) -> tuple[Array, Array]:
    """Return the percentile interval of trials (n, T), each end (T,)."""
    found = stats.bootstrap(
        (values,),  # along the first axis: a draw takes the same trials at every step
        _CENTRES[statistic],
        n_resamples=RESAMPLES,
        batch=_BATCH,
        confidence_level=LEVEL,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return np.asarray(found.low), np.asarray(found.high)


def _interquartile_mean(values: Array, axis: int) -> Array:
    return np.asarray(stats.trim_mean(values, 0.25, axis=axis))


_CENTRES: dict[Statistic, Any] = {
    Statistic.MEAN: np.mean,
    Statistic.MEDIAN: np.median,
    Statistic.IQM: _interquartile_mean,
}
