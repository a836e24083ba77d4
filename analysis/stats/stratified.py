"""Means over several systems, each of which counts alike, with stratified bootstrap intervals.

Runs are drawn with replacement within each system, so that a draw has as many runs of each as there
are (Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", 2021).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from analysis.stats.intervals import CONFIDENCE

Array = npt.NDArray[np.float64]

RESAMPLES = 9999


@dataclass(frozen=True)
class StratifiedMean:
    """A mean over systems of means over runs with its interval, each (k,)."""

    centre: Array
    low: Array
    high: Array


def stratified_mean(strata: Sequence[Array]) -> StratifiedMean:
    """Return the mean over S systems of the means over their runs (n_s, k), each n_s at least 1.

    The interval of 95 % is a percentile bootstrap, pointwise in k; NaN where a system has one run.
    All draws come from a stream of their own, so that those of the same numbers of runs are the
    same.
    """
    centre = np.mean([np.mean(values, axis=0) for values in strata], axis=0)
    if min(map(len, strata)) < 2:
        nothing = np.full_like(centre, np.nan)
        return StratifiedMean(centre, nothing, nothing)
    drawn = np.zeros((RESAMPLES, *centre.shape))
    for place, values in enumerate(strata):
        drawn += _weights(len(values), place) @ values / len(strata)
    tail = 100 * (1 - CONFIDENCE) / 2
    low, high = np.percentile(drawn, [tail, 100 - tail], axis=0)
    return StratifiedMean(centre, low, high)


@functools.lru_cache(maxsize=8)
def _weights(n: int, place: int) -> Array:
    """Return the share that each of n runs of a system has in each draw, (RESAMPLES, n)."""
    rng = np.random.default_rng(place)
    return np.asarray(rng.multinomial(n, np.full(n, 1 / n), size=RESAMPLES) / n)
