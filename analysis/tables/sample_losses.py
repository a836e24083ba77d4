"""Sample losses beside final losses: what a policy collected, and what its learner made of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from operator import itemgetter

import numpy as np
import pandas as pd

from analysis.data.samples import sample_losses, simulated_trial
from analysis.data.selection import Entry, Selection
from analysis.errors import AnalysisError
from analysis.stats.control import geometric_mean
from analysis.style import within
from analysis.tables.rendering import Columns, TableKind, Text, rendered
from dopt.assessment import SAMPLE_LOSS
from dopt.errors import SpecificationError
from dopt.offline_fit import sample_loss
from dopt.result import Assessment
from orchestrate.store import Reader
from orchestrate.store.errors import QueryError

HELP = "loss of one model fitted to the samples of each trial, beside the trial's own final loss"

NOTE = (
    "Geometric means over n trials, with Student's interval of the logarithms. Sample loss: root "
    "mean square error over the evaluation grid of a Gaussian process, tuned by its evidence and "
    "fitted to the trial's own samples: what the policy collected. Final / sample: what the "
    "learner made of it, below 1 it is better than the process."
)

_MEANS = {"loss": "final loss", "sample_loss": "sample loss", "ratio": "final / sample"}

Keep = Callable[[Mapping[str, Assessment]], object]
"""Stores fitted sample losses by trial key."""


def measure_sample_losses(
    reader: Reader, selection: Selection, say: Callable[[str], object], keep: Keep
) -> pd.DataFrame:
    """Return geometric means with intervals, one row for each environment and variant.

    A stored sample loss is taken as it is, others are fitted. ``ratio`` is final / sample loss.

    Raises
    ------
    AnalysisError
        If no selected trial has a sample loss.
    """
    rows = []
    for entry in selection.entries:
        known = sample_losses(reader, entry)
        fitted, left = _fitted(reader, entry, known)
        for why, count in left.items():
            say(f"{entry.config.env}, {entry.label}, trials left out: {count}, {why}")
        new = [(trial, fitted[trial.seed]) for trial in entry.trials if trial.seed in fitted]
        keep({one.trial_key: Assessment(one.n_steps or 0, SAMPLE_LOSS, loss) for one, loss in new})
        if known or fitted:
            rows.append(_row(entry, {**known, **fitted}))
    if not rows:
        raise AnalysisError(
            "No selected trial has a sample loss, but at least one is needed: run the grid, or ask "
            "for trials that are done and whose models read states alone."
        )
    return pd.DataFrame(rows)


def _fitted(
    reader: Reader, entry: Entry, known: Mapping[int, float]
) -> tuple[dict[int, float], Counter[str]]:
    """Return the sample losses that are not known, by seed; and how many are left out, and why."""
    left = Counter("diverged" for trial in entry.trials if trial.status == "diverged")
    seeds = [seed for seed in entry.final_losses() if seed not in known]
    try:
        spec = simulated_trial(entry.config, 0)
        _ = spec.config.process
    except (AnalysisError, SpecificationError) as error:
        return {}, left + Counter({str(error): len(seeds)})
    fitted = {}
    for seed in seeds:
        try:
            stored = reader.trajectory(entry.config.config_key, seed)
            fitted[seed] = sample_loss(spec.with_seed(seed), stored.states, stored.inputs)
        except QueryError:
            left["their states and inputs are not stored"] += 1
        except SpecificationError as error:
            left[str(error)] += 1
    return fitted, left


def _row(entry: Entry, samples: Mapping[int, float]) -> dict[str, object]:
    losses = entry.final_losses()
    final, sample = (np.array([one[seed] for seed in samples]) for one in (losses, samples))
    row: dict[str, object] = {"env": entry.config.env, "policy": entry.config.policy}
    row["label"] = entry.label
    for name, values in zip(_MEANS, (final, sample, final / sample), strict=True):
        columns = (name, f"{name}_low", f"{name}_high")
        row |= zip(columns, geometric_mean(values), strict=True)
    return row | {"n": len(samples)}


def sample_loss_kind(say: Callable[[str], object], keep: Keep) -> TableKind:
    """Return the table; ``say`` is told what is left out, and ``keep`` gets what was fitted."""
    columns: Columns = (
        ("env", itemgetter("env")),
        ("variant", itemgetter("label")),
        *((f"{title} [95 %]", _mean_text(name)) for name, title in _MEANS.items()),
        ("n", itemgetter("n")),
    )
    return TableKind(
        "Final losses beside sample losses",
        lambda selection, *_: selection,
        lambda reader, selection, _: measure_sample_losses(reader, selection, say, keep),
        lambda table, _: rendered(table, columns, NOTE),
    )


def _mean_text(name: str) -> Text:
    return lambda row: within(*(row[f"{name}{end}"] for end in ("", "_low", "_high")))
