"""Paired comparison of two policies: same environment, same seeds, common random numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats

from analysis.statistics import LEVEL

Array = npt.NDArray[np.float64]

RESAMPLES = 9999


@dataclass(frozen=True)
class Comparison:
    """How the losses of one policy compare with those of a baseline over shared seeds.

    Attributes
    ----------
    n_pairs : int
        Seeds on which neither diverged.
    ratio, low, high : float
        Geometric mean of loss / baseline loss, and its paired bootstrap interval; below 1 the
        policy is better.
    p_value : float
        Two-sided Wilcoxon signed-rank test of the logarithms' differences.
    improvement : float
        Probability of improvement: share of pairs with the lower loss, ties counted half.
    """

    n_pairs: int
    ratio: float
    low: float
    high: float
    p_value: float
    improvement: float


def compare(loss: Array, baseline: Array, rng: np.random.Generator) -> Comparison:
    """Compare positive losses, both (n,) and paired by position; NaN where n is too small."""
    difference = np.log(loss) - np.log(baseline)
    if not len(difference):
        return Comparison(0, *[float("nan")] * 5)
    low, high = bootstrap_mean(difference, rng)
    wins = np.mean(difference < 0) + np.mean(difference == 0) / 2
    return Comparison(
        n_pairs=len(difference),
        ratio=float(np.exp(np.mean(difference))),
        low=float(np.exp(low)),
        high=float(np.exp(high)),
        p_value=signed_rank(difference),
        improvement=float(wins),
    )


def bootstrap_mean(values: Array, rng: np.random.Generator) -> tuple[float, float]:
    """Return the bias-corrected, accelerated bootstrap interval of the mean of (n,)."""
    if len(values) < 2:
        return float("nan"), float("nan")
    if np.ptp(values) == 0:
        return float(values[0]), float(values[0])
    found = stats.bootstrap(
        (values,), np.mean, n_resamples=RESAMPLES, confidence_level=LEVEL, rng=rng
    ).confidence_interval
    return float(found.low), float(found.high)


def signed_rank(differences: Array) -> float:
    """Return the two-sided Wilcoxon signed-rank p of (n,); 1 when nothing differs."""
    if not np.any(differences):
        return 1.0
    return float(stats.wilcoxon(differences).pvalue)


def benjamini_hochberg(p_values: Sequence[float]) -> list[float]:
    """Return p adjusted for the false discovery rate over a table; NaN is no test and stays."""
    p = np.asarray(p_values, dtype=float)
    tested = np.isfinite(p)
    adjusted = np.full(p.shape, np.nan)
    if tested.any():
        adjusted[tested] = stats.false_discovery_control(p[tested], method="bh")
    return [float(value) for value in adjusted]
