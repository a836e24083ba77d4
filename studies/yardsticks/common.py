"""Shared parts of the published tables: printed numbers, configurations, medians and ratios.

Table 3 of M. Blanke and M. Lelarge, "FLEX: an adaptive exploration algorithm for nonlinear systems"
(ICML 2023): samples until the frictions of N coupled pendulums are known to 1e-2. A number that is
not reached is printed there as "> 1,000"; here it is infinite. Figure 4: parameter error of the
moving star after the run, over 100 trials, read off the plot. Table 1: samples until a planner with
the learned model swings up the pendulum and the cartpole of the DeepMind Control Suite.

ActiveSysID: error of the rate of an unbalanced disk after 2,000 samples, mean over 10 trials, read
off a plot of K. Xie and A. Bemporad, "Online design of experiments by active learning for nonlinear
system identification" (arXiv 2506.21754).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.data.matching import AnalysisError, latest
from analysis.data.selection import Entry
from analysis.stats.curves import CONFIDENCE
from analysis.style import within
from analysis.tables.comparisons import against_reference
from orchestrate.store import ConfigRow, Reader

FLEX_SIZES = (2, 5, 10, 20, 50)
"""Numbers N of pendulums."""

FLEX_SAMPLES = {
    "random": (20.0, 100.0, 200.0, 500.0, math.inf),
    "FLEX": (10.0, 50.0, 100.0, 200.0, 500.0),
}
"""Samples for each N, by policy."""

FLEX_LONGEST = 1000
"""Samples of the longest run in the table."""

FLEX_STAR = {"random": "about 3", "episodic": "0.1 to 1", "FLEX": "about 1e-3"}
"""Parameter errors, by policy; the episodic one plans again every 50 steps."""

_PENDULUM, _CARTPOLE = ("pendulum", "mlp"), ("cartpole", "mlp")

FLEX_SWING_UP = {
    "random": {_PENDULUM: math.inf, _CARTPOLE: math.inf},
    "MAX": {_PENDULUM: 2000.0, _CARTPOLE: math.inf},
    "SAC": {_PENDULUM: math.inf, _CARTPOLE: math.inf},
    "RHC": {_PENDULUM: 500.0, _CARTPOLE: 600.0},
    "FLEX": {("pendulum", "linear"): 50.0, _CARTPOLE: 300.0},
}
"""Samples by policy, for systems with the kind of model: FLEX has a linear one on the pendulum."""

FLEX_SWING_UP_LONGEST = 2000
"""Samples of the longest run in the table."""

ACTIVE_SYSID = {"random (passive)": 0.93, "gsx": 0.97, "igs": 0.83, "idw": 0.83}
"""Root mean square errors [rad/s] by policy, with the rate bounded."""

Array = npt.NDArray[np.float64]
Interval = tuple[float, float, float]
"""Centre, low and high; NaN without an interval."""

RESAMPLES = 9999
FEWEST_SIZES = 3
"""Sizes below which no exponent is given: two points lie on a line whatever they are."""

REFERENCE = "random"


def distinct_entries(
    reader: Reader,
    belongs: Callable[[ConfigRow], bool],
    place: Callable[[Entry], tuple[Any, ...]],
    named: Callable[[Entry], str],
    example: str,
) -> list[Entry]:
    """Return the newest configurations that belong to a table, in the order of their places.

    Parameters
    ----------
    reader : Reader
        Database.
    belongs : callable
        Whether a configuration belongs to the table.
    place : callable
        Place of an entry in the table, by which the entries are sorted.
    named : callable
        Words for the place of an entry, such as "with the policy 'random'".
    example : str
        Condition that may choose one of several, such as ``env.horizon=1000``.

    Raises
    ------
    AnalysisError
        If two configurations have the same place.
    """
    found = latest(reader, [one for one in reader.configs() if belongs(one)])
    entries = [Entry(one, tuple(reader.trials(one.config_key))) for one in found]
    entries.sort(key=place)
    for one, other in itertools.pairwise(entries):
        if place(one) == place(other):
            raise AnalysisError(
                f"There are two configurations {named(one)}, but one is expected: choose by "
                f"--where, such as --where {example}."
            )
    return entries


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


def interval_columns(name: str, interval: Interval) -> dict[str, float]:
    """Return a value and the ends of its interval by the names of their columns."""
    return dict(zip((name, f"{name}_low", f"{name}_high"), interval, strict=True))


def ratio_to_random(trials: pd.DataFrame, policy: str, measure: str, question: str) -> Interval:
    """Return the geometric mean of the ratio of a measure to random inputs of the same seed.

    ``trials`` has the columns ``policy``, ``seed`` and the measure; ``question`` names what they
    have in common. It is NaN for random inputs themselves, and without random inputs.
    """
    own, reference = (
        dict(zip(part.seed, part[measure], strict=True))
        for part in (trials[trials.policy == one] for one in (policy, REFERENCE))
    )
    if policy == REFERENCE or not reference:
        return np.nan, np.nan, np.nan
    found = against_reference(own, reference, question, policy, measure)
    return found.ratio, found.low, found.high


def ratio_text(row: Mapping[Hashable, Any]) -> str:
    """Return the ratio of a row with its interval."""
    return within(row["ratio"], row["ratio_low"], row["ratio_high"])
