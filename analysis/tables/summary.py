"""Table of final losses."""

from __future__ import annotations

import pandas as pd

from analysis.data.divergence import DivergenceRule
from analysis.data.trial_selection import Entry, Selection
from analysis.stats.intervals import Statistic, centre, standard_error
from analysis.stats.trial_scores import Scores, final_losses
from orchestrate.store import Reader


def summarise(
    reader: Reader, selection: Selection, rule: DivergenceRule = DivergenceRule.EXCLUDE
) -> pd.DataFrame:
    """Return centres of the final losses, one row for each environment and policy.

    For both losses the mean with two standard errors, the median and the interquartile mean.
    """
    return pd.DataFrame([_summary(reader, entry, rule) for entry in selection.entries])


def _summary(reader: Reader, entry: Entry, rule: DivergenceRule) -> dict[str, object]:
    grid = final_losses(reader, entry, "loss", rule)
    reachable = final_losses(reader, entry, "reachable_loss", rule)
    return {
        "env": grid.env,
        "policy": grid.policy,
        "label": grid.label,
        **_centres("loss", grid),
        **_centres("reachable_loss", reachable),
        "n": len(grid.by_seed),
        "n_diverged": grid.n_diverged,
    }


def _centres(name: str, scores: Scores) -> dict[str, float]:
    values = scores.values
    return {
        name: float(centre(values, Statistic.MEAN)),
        f"{name}_2se": 2 * float(standard_error(values)),
        f"{name}_median": float(centre(values, Statistic.MEDIAN)),
        f"{name}_iqm": float(centre(values, Statistic.IQM)),
    }
