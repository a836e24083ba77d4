"""Geometric means over trials with their intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from analysis.stats.intervals import interval_of_mean

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """A geometric mean over trials with its 95 % interval, NaN for fewer than two."""

    value: float
    low: float
    high: float


def geometric_mean(values: Array) -> Estimate:
    """Return the geometric mean of (n,); NaN for none and where a value has no logarithm.

    The interval is that of the mean logarithm: a BCa bootstrap, Student's for few trials.
    """
    if not len(values) or not np.all((values > 0) & np.isfinite(values)):
        return Estimate(*[float("nan")] * 3)
    logs = np.log(values)
    low, high = interval_of_mean(logs, np.random.default_rng(0))
    return Estimate(*(float(np.exp(end)) for end in (np.mean(logs), low, high)))
