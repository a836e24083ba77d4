"""Scores: one number for each trial, which tables average and comparisons pair."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from analysis.data.curves import read_sample
from analysis.data.divergence import DivergenceRule
from analysis.data.trial_selection import Entry
from orchestrate.store import Reader

Array = npt.NDArray[np.float64]


class Measure(StrEnum):
    """Measure by which a trial is judged.

    ``FINAL`` is the loss after the last step, ``AUC`` the geometric mean of the loss over all
    steps, whose logarithm is the area under the logarithmic loss curve by its length, and ``STEPS``
    the number of inputs until the loss first is at most ε.
    """

    FINAL = "final"
    AUC = "auc"
    STEPS = "steps"


@dataclass(frozen=True)
class Scores:
    """One number for each seed of an entry, the divergence rule applied, and counts."""

    env: str
    policy: str
    label: str
    by_seed: Mapping[int, float]
    n_finished: int
    n_diverged: int

    @property
    def values(self) -> Array:
        """The numbers (n,), by seed."""
        return np.array([self.by_seed[seed] for seed in sorted(self.by_seed)], dtype=float)

    def describe(self) -> str:
        """Return the count to print, such as ``98/100, 2 diverged``."""
        used = len(self.by_seed)
        if not self.n_diverged:
            return str(used)
        return f"{used}/{self.n_finished}, {self.n_diverged} diverged"


def final_losses(reader: Reader, entry: Entry, column: str, rule: DivergenceRule) -> Scores:
    """Return the loss after the last step of each trial; from the summary column where it is."""
    if column != "loss" or rule is not DivergenceRule.EXCLUDE:
        return _scores(reader, entry, column, rule, lambda values: values[:, -1])
    return _counted(entry, entry.final_losses())


def mean_losses(reader: Reader, entry: Entry, column: str, rule: DivergenceRule) -> Scores:
    """Return the geometric mean of the loss over all steps of each trial."""
    return _scores(reader, entry, column, rule, geometric_mean)


def steps_to(
    reader: Reader, entry: Entry, column: str, rule: DivergenceRule, threshold: float
) -> Scores:
    """Return the steps until the loss first is at most the threshold, inf where it never is."""
    return _scores(reader, entry, column, rule, lambda values: first_passage(values, threshold))


def lasting_steps(
    reader: Reader, entry: Entry, column: str, rule: DivergenceRule, threshold: float
) -> Scores:
    """Return the steps until the loss stays at most the threshold, inf where it does not."""
    return _scores(reader, entry, column, rule, lambda values: last_passage(values, threshold))


def geometric_mean(values: Array) -> Array:
    """Return exp of the mean logarithm along the steps of losses (n, T); 0 where one of them is."""
    with np.errstate(divide="ignore"):
        found: Array = np.exp(np.mean(np.log(values), axis=1))
    return found


def first_passage(values: Array, threshold: float) -> Array:
    """Return the number of inputs until a curve of (n, T) first is at most the threshold.

    The first loss counts as one input. A curve that never gets there is censored: inf.
    """
    reached = values <= threshold
    return np.where(reached.any(axis=1), reached.argmax(axis=1) + 1.0, np.inf)


def last_passage(values: Array, threshold: float) -> Array:
    """Return the number of inputs after which a curve of (n, T) stays at most the threshold.

    The first loss counts as one input. A curve that ends above it is censored: inf.
    """
    above = ~(values <= threshold)
    n_steps = values.shape[1]
    last = np.where(above.any(axis=1), n_steps - above[:, ::-1].argmax(axis=1), 0)
    return np.where(last < n_steps, last + 1.0, np.inf)


def _scores(
    reader: Reader,
    entry: Entry,
    column: str,
    rule: DivergenceRule,
    score: Callable[[Array], Array],
) -> Scores:
    sample = read_sample(reader, entry, column, rule)
    scores = score(sample.values).tolist()
    return _counted(entry, dict(zip(sample.seeds.tolist(), scores, strict=True)))


def _counted(entry: Entry, by_seed: Mapping[int, float]) -> Scores:
    diverged = sum(trial.status == "diverged" for trial in entry.trials)
    names = entry.config.env, entry.config.policy, entry.label
    return Scores(*names, by_seed, len(entry.finished), diverged)
