"""Tables of final losses: a summary, and the reference policy against every baseline."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from analysis.choice import REFERENCE
from analysis.divergence import DivergenceRule
from analysis.errors import AnalysisError
from analysis.paired import benjamini_hochberg, compare
from analysis.reading import read_sample
from analysis.selection import Entry, Selection
from analysis.statistics import mean, standard_error
from orchestrate.store import Reader

Losses = Mapping[int, float]


@dataclass(frozen=True)
class Finals:
    """Final losses of one entry by seed, the divergence rule applied, and counts."""

    env: str
    policy: str
    losses: Losses
    n_finished: int
    n_diverged: int

    def describe(self) -> str:
        """Return the count to print, such as ``98/100, 2 diverged``."""
        used = len(self.losses)
        if not self.n_diverged:
            return str(used)
        return f"{used}/{self.n_finished}, {self.n_diverged} diverged"


def final_losses(reader: Reader, entry: Entry, column: str, rule: DivergenceRule) -> Finals:
    """Return the loss after the last step of each trial; from the summary column where it is."""
    diverged = sum(trial.status == "diverged" for trial in entry.trials)
    if column == "loss" and rule is DivergenceRule.EXCLUDE:
        losses = entry.final_losses()
    else:
        sample = read_sample(reader, entry, column, rule)
        losses = dict(zip(sample.seeds.tolist(), sample.values[:, -1].tolist(), strict=True))
    return Finals(entry.cell.env, entry.cell.policy, losses, len(entry.finished), diverged)


def summarise(
    reader: Reader, selection: Selection, rule: DivergenceRule = DivergenceRule.EXCLUDE
) -> pd.DataFrame:
    """Return mean and 2 SE of the final losses, one row for each environment and policy."""
    return pd.DataFrame([_summary(reader, entry, rule) for entry in selection.entries])


def _summary(reader: Reader, entry: Entry, rule: DivergenceRule) -> dict[str, object]:
    grid = final_losses(reader, entry, "loss", rule)
    reachable = final_losses(reader, entry, "reachable_loss", rule)
    row: dict[str, object] = {"env": grid.env, "policy": grid.policy}
    for name, finals in (("loss", grid), ("reachable_loss", reachable)):
        values = np.array(list(finals.losses.values()), dtype=float)
        row[name] = float(mean(values))
        row[f"{name}_2se"] = 2 * float(standard_error(values))
    return row | {"n": len(grid.losses), "n_diverged": grid.n_diverged}


def compare_policies(
    reader: Reader,
    selection: Selection,
    column: str = "loss",
    rule: DivergenceRule = DivergenceRule.EXCLUDE,
) -> pd.DataFrame:
    """Return the reference policy against every baseline, paired over seeds.

    One row for each environment and baseline; ``p_adjusted`` is the Benjamini-Hochberg adjustment
    of the Wilcoxon p over the whole table.
    """
    rows = []
    for env in selection.environments:
        finals = [final_losses(reader, entry, column, rule) for entry in selection.of(env)]
        reference = next((one for one in finals if one.policy == REFERENCE), None)
        baselines = [one for one in finals if one.policy != REFERENCE]
        rows += [_comparison(reference, one, column) for one in baselines if reference]
    if not rows:
        raise AnalysisError(
            f"A comparison needs trials of {REFERENCE} and of a baseline in one environment, "
            f"but only {', '.join(selection.policies)} is selected: run the others, or ask wider."
        )
    table = pd.DataFrame(rows, columns=_COLUMNS[:-1])
    table["p_adjusted"] = benjamini_hochberg(table["p_value"].tolist())
    return table[_COLUMNS]


_COLUMNS = [
    "env",
    "baseline",
    "n_pairs",
    "ratio",
    "low",
    "high",
    "improvement",
    "p_value",
    "p_adjusted",
]


def _comparison(reference: Finals, baseline: Finals, column: str) -> dict[str, object]:
    seeds = sorted(set(reference.losses) & set(baseline.losses))
    found = compare(
        np.array([reference.losses[seed] for seed in seeds]),
        np.array([baseline.losses[seed] for seed in seeds]),
        _stream(reference.env, baseline.policy, column),
    )
    return {"env": reference.env, "baseline": baseline.policy, **vars(found)}


def _stream(*names: str) -> np.random.Generator:
    """Return a generator of the row's own: its interval does not depend on the other rows."""
    digest = hashlib.sha256("/".join(names).encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "little"))
