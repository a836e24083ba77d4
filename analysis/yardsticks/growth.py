"""Growth of a number of samples with the size N of a system: the exponent a of samples ∝ N^a."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from analysis.stats.intervals import CONFIDENCE

Array = npt.NDArray[np.float64]
Interval = tuple[float, float, float]
"""Centre, low and high; NaN where there is none."""

RESAMPLES = 9999
FEWEST_SIZES = 3
"""Sizes below which no exponent is given: two points lie on a line whatever they are."""


def median(values: Array, rng: np.random.Generator) -> Interval:
    """Return the median of samples, (n,), inf where censored, with its bootstrap interval."""
    return float(np.median(values)), *_interval(_medians(values, rng))


def exponent(by_size: Mapping[int, Array], rng: np.random.Generator) -> Interval:
    """Return the exponent of the medians of samples, (n,) for each N, with its bootstrap interval.

    It is the slope of the least-squares line through log median against log N, over the sizes whose
    median is finite. A draw takes the trials of each size with replacement.
    """
    kept = {size: values for size, values in by_size.items() if np.isfinite(np.median(values))}
    if len(kept) < FEWEST_SIZES:
        return np.nan, np.nan, np.nan
    sizes = sorted(kept)
    centre = slopes(sizes, np.array([[np.median(kept[size]) for size in sizes]]))
    drawn = np.stack([_medians(kept[size], rng) for size in sizes], axis=1)
    return float(centre[0]), *_interval(slopes(sizes, drawn))


def slopes(sizes: Sequence[int], samples: Array) -> Array:
    """Return the slope, (B,), of log samples, (B, k), against the logarithms of k sizes."""
    x = np.log(np.array(sizes, dtype=float))
    x -= x.mean()
    found: Array = np.log(samples) @ (x / (x @ x))
    return found


def _medians(values: Array, rng: np.random.Generator) -> Array:
    drawn = rng.integers(len(values), size=(RESAMPLES, len(values)))
    found: Array = np.median(values[drawn], axis=1)
    return found


def _interval(drawn: Array) -> tuple[float, float]:
    """Return the percentile interval; of the drawn values themselves, some of which may be inf."""
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(drawn, [tail, 1 - tail], method="nearest")
    return float(low), float(high)
