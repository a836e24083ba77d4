"""Paired comparisons: every variant against one reference, over the seeds that they share.

All tables, the report and the browser take their ratios from :func:`against_reference`. A ratio is
always variant / reference: below 1 the variant has the lower value.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.data.divergence import DivergenceRule
from analysis.data.trial_selection import Entry, Selection
from analysis.errors import AnalysisError
from analysis.stats.control import relative_costs, scores_at
from analysis.stats.paired_tests import (
    Comparison,
    benjamini_hochberg,
    compare,
    compare_hitting_times,
    without_ratio,
)
from analysis.stats.trial_scores import Measure, Scores, final_losses, mean_losses, steps_to
from orchestrate.store import Reader

Array = npt.NDArray[np.float64]
BySeed = Mapping[int, float]
Score = Callable[[Reader, Entry, str, DivergenceRule], Scores]
Pair = tuple[Scores, Scores]
"""The scores of a variant and of the reference."""

EPSILON_POLICY = "random"
"""The policy whose median final loss is the ε that others are to reach."""

_SCORES: dict[Measure, Score] = {Measure.FINAL: final_losses, Measure.AUC: mean_losses}


def against_reference(
    own: BySeed, reference: BySeed, env: str, variant: str, measure: str
) -> Comparison:
    """Return how a variant compares with the reference on the seeds that they share.

    The bootstrap has a random stream of its own for each environment, label and measure. A label
    names what differs in the table, so that other groups draw other samples.
    """
    name = "/".join(("report", env, variant, measure))
    stream = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
    return compare(*paired(own, reference), np.random.default_rng(stream))


def paired(own: BySeed, reference: BySeed) -> tuple[Array, Array]:
    """Return the scores of the two, each (n,), on the n seeds that they share."""
    seeds = sorted(set(own) & set(reference))
    ours, theirs = (np.array([one[seed] for seed in seeds], float) for one in (own, reference))
    return ours, theirs


def compare_policies(
    reader: Reader,
    selection: Selection,
    column: str = "loss",
    rule: DivergenceRule = DivergenceRule.EXCLUDE,
    measure: Measure = Measure.FINAL,
) -> pd.DataFrame:
    """Return the ratio of losses, one row for each environment and variant.

    ``p_adjusted`` is the Benjamini-Hochberg adjustment of the Wilcoxon p over the whole table.
    """
    name = "auc" if measure is Measure.AUC else column
    rows = []
    for env in selection.environments:
        scores = [_SCORES[measure](reader, entry, column, rule) for entry in selection.of(env)]
        for own, reference in _pairs(scores, selection, env):
            found = against_reference(own.by_seed, reference.by_seed, env, own.label, name)
            rows.append(_row(own, reference) | asdict(found) | _diverged(own, reference))
    return _adjusted(rows, selection)


def compare_steps(
    reader: Reader,
    selection: Selection,
    column: str = "loss",
    rule: DivergenceRule = DivergenceRule.EXCLUDE,
    epsilon: float | None = None,
) -> pd.DataFrame:
    """Return who reaches the loss ε first, one row for each environment and variant.

    Without ``epsilon`` it is the median final loss of random inputs, so that the question is when a
    policy knows what random inputs know at the end; environments without them are left out.

    Raises
    ------
    AnalysisError
        If ε is no positive number, or there is nothing to compare.
    """
    if epsilon is not None and not 0 < epsilon < math.inf:
        raise AnalysisError(
            f"The loss to reach, --epsilon, is {epsilon:g}, but a positive number is expected: "
            f"choose one between the losses of figure 1."
        )
    rows = []
    for env in selection.environments:
        entries = selection.of(env)
        threshold = (
            loss_of_random_inputs(reader, entries, column, rule) if epsilon is None else epsilon
        )
        if threshold is None:
            continue
        scores = [steps_to(reader, entry, column, rule, threshold) for entry in entries]
        facts = {"epsilon": threshold, "horizon": entries[0].config.horizon}
        for own, reference in _pairs(scores, selection, env):
            found = compare_hitting_times(*paired(own.by_seed, reference.by_seed))
            rows.append(_row(own, reference) | facts | asdict(found) | _diverged(own, reference))
    if not rows and selection.compared().entries and len(selection.entries) > 1:
        raise AnalysisError(
            f"Steps to a loss need that loss or trials of {EPSILON_POLICY}, whose median final "
            f"loss it would be, but neither is given: add --epsilon, or select {EPSILON_POLICY} "
            f"too."
        )
    return _adjusted(rows, selection)


def loss_of_random_inputs(
    reader: Reader, entries: tuple[Entry, ...], column: str, rule: DivergenceRule
) -> float | None:
    """Return the median final loss of random inputs, None where there are no trials of them."""
    found = (entry for entry in entries if entry.config.policy == EPSILON_POLICY)
    finals = next((final_losses(reader, entry, column, rule).values for entry in found), None)
    return float(np.median(finals)) if finals is not None and len(finals) else None


def compare_control(reader: Reader, selection: Selection) -> pd.DataFrame:
    """Return the ratio of the costs of control, one row for each environment, step and variant.

    The cost of a trial is that of the episode which its model planned, by the true model's.
    ``n_lost`` pairs are in no ratio: one of the two episodes, or the true model's, has no finite
    cost. An episode's own loss counts as the worst in the test; where the true model's was lost,
    nothing is known.
    """
    rows = []
    for env in selection.environments:
        entries = selection.of(env)
        steps = sorted({int(t) for entry in entries for t in relative_costs(reader, entry).t})
        for t in steps:
            if t == 0:  # the same untrained model for all
                continue
            successes = {entry.label: _successes(reader, entry, t) for entry in entries}
            scores = [scores_at(reader, entry, t) for entry in entries]
            for own, reference in _pairs(scores, selection, env):
                values = paired(own.by_seed, reference.by_seed)
                found = against_reference(
                    own.by_seed, reference.by_seed, env, own.label, f"control/{t}"
                )
                row = _row(own, reference) | {"t": t, "success": successes[own.label]}
                row |= {"success_reference": successes[reference.label]} | asdict(found)
                row |= {"n_lost": without_ratio(*values)} | _diverged(own, reference)
                rows.append(row)
    return _adjusted(rows, selection)


def _successes(reader: Reader, entry: Entry, t: int) -> float:
    """Return the share of successful episodes after t explored steps, NaN for none."""
    found = reader.assessments(entry.config.config_key, "control_success")
    known = found.values[:, found.t == t]
    known = known[np.isfinite(known)]
    return float(np.mean(known)) if len(known) else math.nan


def _pairs(scores: list[Scores], selection: Selection, env: str) -> Iterator[Pair]:
    """Yield the scores of each variant of an environment with those of the reference."""
    wanted = selection.reference_of(env)
    reference = next((one for one in scores if wanted and one.label == wanted.label), None)
    for one in scores:
        if reference is not None and one is not reference:
            yield one, reference


def _row(own: Scores, reference: Scores) -> dict[str, object]:
    return {
        "env": own.env,
        "policy": own.policy,
        "variant": own.label,
        "reference": reference.label,
    }


def _diverged(own: Scores, reference: Scores) -> dict[str, object]:
    return {"n_diverged": own.n_diverged + reference.n_diverged}


def _adjusted(rows: list[dict[str, object]], selection: Selection) -> pd.DataFrame:
    if not rows:
        raise AnalysisError(
            f"A comparison needs trials of the reference {selection.reference} and of another "
            f"variant in one environment, but only {', '.join(selection.labels)} is selected: run "
            f"the others, ask wider, or choose another --reference."
        )
    table = pd.DataFrame(rows)
    table["p_adjusted"] = benjamini_hochberg(table["p_value"].tolist())
    return table
