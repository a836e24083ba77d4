"""Matrices of a selection's trials, exactly those that were selected."""

from __future__ import annotations

import numpy as np

from analysis.data.divergence import DivergenceRule, Sample, apply_rule
from analysis.data.trial_selection import Entry
from orchestrate.store import Curves, Reader


def read_curves(reader: Reader, entry: Entry, column: str) -> Curves:
    """Return one column of the entry's finished trials.

    A launch may be writing: trials that ended after the selection was made are left out. Curves of
    explorations are cut at the end of the shortest, so that all of them are compared at each step.
    """
    curves = reader.curves(entry.config.config_key, column)
    kept = np.isin(curves.seeds, [trial.seed for trial in entry.finished])
    lengths = [trial.n_steps or 0 for trial in entry.finished if trial.status == "done"]
    n = min(lengths, default=len(curves.t))
    return Curves(curves.seeds[kept], curves.t[:n], curves.values[kept, :n], curves.diverged[kept])


def read_sample(reader: Reader, entry: Entry, column: str, rule: DivergenceRule) -> Sample:
    """Return the curves (n, T) that a statistic sees."""
    curves = read_curves(reader, entry, column)
    return apply_rule(curves.seeds, curves.values, curves.diverged, rule)
