"""Centres of trials and their intervals, on the exact time grid; no smoothing, no sampling of runs.

Three statistics over the trials of a configuration, each with the interval that suits it: the mean
with Student's interval, and the median and the interquartile mean (IQM: the mean of the middle
half; Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", 2021)
with a percentile bootstrap that draws whole trials.

Tolerance intervals say what one run does, where an interval of the mean says what they do together.
They are distribution-free, by order statistics (Wilks, "Determination of sample sizes for setting
tolerance limits", 1941): of n independent runs sorted by value, the share of the distribution
between the r-th smallest and the s-th smallest has the distribution Beta(s - r, n - s + r + 1).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Counts = npt.NDArray[np.integer[Any]]

CONFIDENCE = 0.95
"""Confidence level of every interval."""

BAND_RESAMPLES = 1999
"""Draws of a bootstrap band: the 2.5 % quantile is then the 50th smallest."""

MEAN_RESAMPLES = 9999
"""Draws of a bootstrap of one mean, and of means over systems."""

FEWEST_BOOTSTRAP_VALUES = 30
"""Values below which a bootstrap is too narrow (95 % meant, of normal differences: 82 % for 5,
93.8 % for 20; of exponential ones 89 % for 20); Student's is nearer (91 % of exponential ones)."""

MOST_BOOTSTRAP_VALUES = 2000
"""Values above which the mean has Student's interval: the time of the bootstrap grows with their
square. The ends differ by less than 5 % of a half-width there, of normal and of exponential values,
where the draws of the bootstrap alone make 3 %."""

_ROUNDING = 1e-14
"""Spread of values that differ by rounding alone, relative to the largest."""

STUDENT_RANGE = f"Student's below {FEWEST_BOOTSTRAP_VALUES} and above {MOST_BOOTSTRAP_VALUES}"
"""Numbers of values whose interval is Student's, for the notes of tables and figures."""

CONTENT = 0.9
"""Share of the runs that an interval is to hold."""

FEWEST = 46
"""Runs below which no two of them hold that share with that confidence."""


class Statistic(StrEnum):
    """Statistic of the trials that a curve shows at each step."""

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


def mean_columns(name: str, values: Array) -> dict[str, float]:
    """Return the mean of (n,) and two standard errors, as columns ``name`` and ``name_2se``."""
    return {name: float(mean(values)), f"{name}_2se": 2 * float(standard_error(values))}


def centre(values: Array, statistic: Statistic) -> Array:
    """Return a statistic along the first axis of (n, ...), NaN for none."""
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    found: Array = np.asarray(_CENTRES[statistic](values, axis=0))
    return found


def band(values: Array, statistic: Statistic = Statistic.MEAN) -> Band:
    """Return the centre of trials (n, T) at each step, with its 95 % interval.

    Mean: ± t·SE, t the two-sided Student quantile of n - 1. Median and IQM: percentile bootstrap.
    The draws have their own random stream, so that the band of the same trials is the same.
    """
    middle, n = centre(values, statistic), len(values)
    if n < 2:
        return _without_interval(middle, n)
    if statistic is Statistic.MEAN:
        half = student_quantile(n - 1) * standard_error(values)
        return Band(middle, middle - half, middle + half, n)
    return Band(middle, *_bootstrap(values, statistic), n)


def _without_interval(middle: Array, n: int) -> Band:
    unknown = np.full_like(middle, np.nan)
    return Band(middle, unknown, unknown, n)


def interval_of_mean(values: Array, rng: np.random.Generator) -> tuple[float, float]:
    """Return the interval of the mean of (n,): a BCa bootstrap, Student's for few and many."""
    if len(values) < 2:
        return float("nan"), float("nan")
    if np.ptp(values) <= _ROUNDING * np.abs(values).max():
        return float(values[0]), float(values[0])
    if not FEWEST_BOOTSTRAP_VALUES <= len(values) <= MOST_BOOTSTRAP_VALUES:
        half = student_quantile(len(values) - 1) * float(standard_error(values))
        return float(np.mean(values)) - half, float(np.mean(values)) + half
    from scipy import stats

    found = stats.bootstrap(
        (values,), np.mean, n_resamples=MEAN_RESAMPLES, confidence_level=CONFIDENCE, rng=rng
    ).confidence_interval
    return float(found.low), float(found.high)


def student_quantile(freedom: int) -> float:
    """Return how many standard errors Student's two-sided interval reaches to each side."""
    from scipy.special import stdtrit  # what scipy.stats calls, whose import takes longer

    return float(stdtrit(freedom, 0.5 + CONFIDENCE / 2))


def _bootstrap(values: Array, statistic: Statistic) -> tuple[Array, Array]:
    """Return the percentile interval of trials (n, T), each end (T,).

    A draw takes the same trials at every step. Median and IQM are means of the middle of a sorted
    sample: with the trials sorted once at each step, how often a draw has each of them says what
    its middle is, so that no draw is sorted.
    """
    n, steps = values.shape
    first, last = _middle(n, statistic)
    counts = _draws(n)
    order = np.argsort(values, axis=0, kind="stable")
    ranked = np.take_along_axis(values, order, axis=0)
    found = np.empty((BAND_RESAMPLES, steps))
    for t in range(steps):
        weights = _middle_counts(counts[order[:, t]], first, last)
        found[:, t] = ranked[:, t] @ weights.astype(float) / (last - first)
    return _ends(found)


def _ends(drawn: Array) -> tuple[Array, Array]:
    """Return the percentile interval of draws (k, ...)."""
    tail = 100 * (1 - CONFIDENCE) / 2
    low, high = np.percentile(drawn, [tail, 100 - tail], axis=0)
    return low, high


def _middle_counts(counts: Counts, first: int, last: int) -> Counts:
    """Return how often each trial is in the middle of each draw, trials (n, ...) by rising value.

    The sums are made row by row: numpy's own along the first axis takes three times as long.
    """
    below = np.empty_like(counts)
    total = np.zeros_like(counts[0])
    for place, count in enumerate(counts):
        total += count
        below[place] = total
    np.clip(below, first, last, out=below)
    below[1:] -= below[:-1].copy()
    below[0] -= first
    return below


def _middle(n: int, statistic: Statistic) -> tuple[int, int]:
    """Return the half-open range of places in a sorted sample of n whose mean is the statistic."""
    if statistic is Statistic.MEDIAN:
        return (n - 1) // 2, n // 2 + 1
    return n // 4, n - n // 4


@functools.lru_cache(maxsize=8)
def _draws(n: int) -> Counts:
    """Return how often each trial of n is in each draw of n, (n, BAND_RESAMPLES)."""
    drawn = np.random.default_rng(0).integers(0, n, (BAND_RESAMPLES, n))
    counts: Counts = np.zeros((n, BAND_RESAMPLES), np.int16 if n < 2**15 else np.int32)
    np.add.at(counts, (drawn, np.arange(BAND_RESAMPLES)[:, None]), 1)
    return counts


def _interquartile_mean(values: Array, axis: int) -> Array:
    from scipy import stats

    return np.asarray(stats.trim_mean(values, 0.25, axis=axis))


_CENTRES: dict[Statistic, Any] = {
    Statistic.MEAN: np.mean,
    Statistic.MEDIAN: np.median,
    Statistic.IQM: _interquartile_mean,
}


class BandKind(StrEnum):
    """Kind of interval around a curve: of the centre of the runs, or of single runs."""

    CONFIDENCE = "confidence"
    TOLERANCE = "tolerance"

    def label(self, statistic: Statistic) -> str:
        """Return the name in a caption, beside a centre."""
        if self is BandKind.CONFIDENCE:
            return statistic.band
        content, confidence = (f"{100 * one:.0f} %" for one in (CONTENT, CONFIDENCE))
        return f"tolerance interval, {content} of runs with {confidence} confidence"


def tolerance_band(values: Array, statistic: Statistic = Statistic.MEAN) -> Band:
    """Return the centre of trials (n, T) and the limits that hold 90 % of runs, at each step.

    Below :data:`FEWEST` trials the limits are NaN.
    """
    n = len(values)
    middle, places = centre(values, statistic), tolerance_places(n)
    if places is None:
        return _without_interval(middle, n)
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


def stratified_mean(strata: Sequence[Array]) -> Band:
    """Return the mean over S systems of the means over their runs (n_s, k), each n_s at least 1.

    The interval of 95 % is a percentile bootstrap, pointwise in k; NaN where a system has one run.
    The draws have their own random stream: equal numbers of runs give equal draws.
    """
    middle = np.mean([np.mean(values, axis=0) for values in strata], axis=0)
    n = sum(map(len, strata))
    if min(map(len, strata)) < 2:
        return _without_interval(middle, n)
    drawn = np.zeros((MEAN_RESAMPLES, *middle.shape))
    for place, values in enumerate(strata):
        drawn += _weights(len(values), place) @ values / len(strata)
    return Band(middle, *_ends(drawn), n)


@functools.lru_cache(maxsize=8)
def _weights(n: int, place: int) -> Array:
    """Return the share that each of n runs of a system has in each draw, (MEAN_RESAMPLES, n)."""
    rng = np.random.default_rng(place)
    return np.asarray(rng.multinomial(n, np.full(n, 1 / n), size=MEAN_RESAMPLES) / n)


@dataclass(frozen=True)
class Estimate:
    """A geometric mean over trials with its 95 % interval, NaN for fewer than two."""

    value: float
    low: float
    high: float


def geometric_mean(values: Array) -> Estimate:
    """Return the geometric mean of (n,); NaN for none and where a value has no logarithm.

    The interval belongs to the mean logarithm: a BCa bootstrap, Student's for few trials.
    """
    if not len(values) or not np.all((values > 0) & np.isfinite(values)):
        return Estimate(*[float("nan")] * 3)
    logs = np.log(values)
    low, high = interval_of_mean(logs, np.random.default_rng(0))
    return Estimate(*(float(np.exp(end)) for end in (np.mean(logs), low, high)))
