"""Comparison over all systems at once: every variant against the reference, paired over seeds."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.data.divergence import DivergenceRule
from analysis.data.trial_selection import Selection
from analysis.stats.stratified import stratified_mean
from analysis.stats.trial_scores import Scores, final_losses
from analysis.tables.comparisons import nothing_to_compare, paired, references
from orchestrate.store import Reader

Array = npt.NDArray[np.float64]
Pair = tuple[Scores, Scores]


def aggregate(
    reader: Reader, selection: Selection, rule: DivergenceRule = DivergenceRule.EXCLUDE
) -> pd.DataFrame:
    """Return the ratio of final losses over all systems, one row for each variant.

    It is the geometric mean over systems of the geometric means over shared seeds of variant /
    reference, with the interval of :func:`analysis.stats.stratified.stratified_mean`. Every system
    counts alike. A variant is compared over those that have it: ``systems``.

    Raises
    ------
    AnalysisError
        If the reference shares no seed with another variant.
    """
    found: dict[str, list[Pair]] = {}
    selection = selection.simulated()
    for env in selection.environments:
        for own, reference, _ in references(selection, env):
            ours, theirs = (final_losses(reader, one, "loss", rule) for one in (own, reference))
            if set(ours.by_seed) & set(theirs.by_seed):
                found.setdefault(own.label, []).append((ours, theirs))
    if not found:
        raise nothing_to_compare(selection)
    return pd.DataFrame([_row(variant, pairs) for variant, pairs in found.items()])


def _row(variant: str, pairs: list[Pair]) -> dict[str, object]:
    logs = [_log_ratios(own, reference) for own, reference in pairs]
    mean = stratified_mean(logs)
    return {
        "variant": variant,
        "reference": pairs[0][1].label,
        "systems": ", ".join(own.env for own, _ in pairs),
        "ratio": float(np.exp(mean.centre)),
        "low": float(np.exp(mean.low)),
        "high": float(np.exp(mean.high)),
        "n_pairs": sum(map(len, logs)),
        "n_diverged": sum(own.n_diverged + reference.n_diverged for own, reference in pairs),
    }


def _log_ratios(own: Scores, reference: Scores) -> Array:
    """Return the logarithms of the ratios (n,); NaN for a loss that has none."""
    ours, theirs = paired(own.by_seed, reference.by_seed)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs: Array = np.log(ours / theirs)
    return np.where(np.isfinite(logs), logs, np.nan)
