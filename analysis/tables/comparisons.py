"""The reference policy against every baseline, paired over seeds, as tables."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.choice import REFERENCE
from analysis.control import relative_costs, scores_at
from analysis.divergence import DivergenceRule
from analysis.errors import AnalysisError
from analysis.measures import Measure, Scores, final_losses, mean_losses, steps_to
from analysis.paired import benjamini_hochberg, compare, race, without_ratio
from analysis.selection import Entry, Selection
from orchestrate.store import Reader

Array = npt.NDArray[np.float64]
Score = Callable[[Reader, Entry, str, DivergenceRule], Scores]

YARDSTICK = "random"
"""The policy whose median final loss is the ε that others are to reach."""

_SCORES: dict[Measure, Score] = {Measure.FINAL: final_losses, Measure.AUC: mean_losses}


def compare_policies(
    reader: Reader,
    selection: Selection,
    column: str = "loss",
    rule: DivergenceRule = DivergenceRule.EXCLUDE,
    measure: Measure = Measure.FINAL,
) -> pd.DataFrame:
    """Return the ratio of losses, one row for each environment and baseline.

    ``p_adjusted`` is the Benjamini-Hochberg adjustment of the Wilcoxon p over the whole table.
    """
    rows = []
    for env in selection.environments:
        scores = [_SCORES[measure](reader, entry, column, rule) for entry in selection.of(env)]
        for baseline, ours, theirs, diverged in _pairs(scores):
            stream = _stream(env, baseline, column, measure)
            row = _row(env, baseline) | asdict(compare(ours, theirs, stream))
            rows.append(row | {"n_diverged": diverged})
    return _adjusted(rows, selection)


def compare_steps(
    reader: Reader,
    selection: Selection,
    column: str = "loss",
    rule: DivergenceRule = DivergenceRule.EXCLUDE,
    epsilon: float | None = None,
) -> pd.DataFrame:
    """Return who reaches the loss ε first, one row for each environment and baseline.

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
        for baseline, ours, theirs, diverged in _pairs(scores):
            row = _row(env, baseline) | {"epsilon": threshold, "horizon": entries[0].cell.horizon}
            rows.append(row | asdict(race(ours, theirs)) | {"n_diverged": diverged})
    if not rows and REFERENCE in selection.policies and len(selection.policies) > 1:
        raise AnalysisError(
            f"Steps to a loss need that loss or trials of {YARDSTICK}, whose median final loss it "
            f"would be, but neither is given: add --epsilon, or select {YARDSTICK} too."
        )
    return _adjusted(rows, selection)


def loss_of_random_inputs(
    reader: Reader, entries: tuple[Entry, ...], column: str, rule: DivergenceRule
) -> float | None:
    """Return the median final loss of random inputs, None where there are no trials of them."""
    found = (entry for entry in entries if entry.cell.policy == YARDSTICK)
    finals = next((final_losses(reader, entry, column, rule).values for entry in found), None)
    return float(np.median(finals)) if finals is not None and len(finals) else None


def compare_control(reader: Reader, selection: Selection) -> pd.DataFrame:
    """Return the ratio of the costs of control, one row for each environment, step and baseline.

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
            successes = {entry.cell.policy: _successes(reader, entry, t) for entry in entries}
            scores = [scores_at(reader, entry, t) for entry in entries]
            for baseline, ours, theirs, diverged in _pairs(scores):
                stream = _stream(env, baseline, "control_cost", str(t))
                row = {"env": env, "t": t, "baseline": baseline}
                row |= {"success": successes[REFERENCE], "success_baseline": successes[baseline]}
                row |= asdict(compare(ours, theirs, stream))
                row |= {"n_lost": without_ratio(ours, theirs), "n_diverged": diverged}
                rows.append(row)
    return _adjusted(rows, selection)


def _successes(reader: Reader, entry: Entry, t: int) -> float:
    """Return the share of successful episodes after t explored steps, NaN for none."""
    found = reader.assessments(entry.cell.config_key, "control_success")
    known = found.values[:, found.t == t]
    known = known[np.isfinite(known)]
    return float(np.mean(known)) if len(known) else math.nan


def _pairs(scores: list[Scores]) -> Iterator[tuple[str, Array, Array, int]]:
    """Yield each baseline with the scores of the reference and its own on the shared seeds.

    Last comes how many trials of the two diverged.
    """
    reference = next((one for one in scores if one.policy == REFERENCE), None)
    for one in scores:
        if reference is None or one is reference:
            continue
        seeds = sorted(set(reference.by_seed) & set(one.by_seed))
        yield (
            one.policy,
            np.array([reference.by_seed[seed] for seed in seeds]),
            np.array([one.by_seed[seed] for seed in seeds]),
            reference.n_diverged + one.n_diverged,
        )


def _row(env: str, baseline: str) -> dict[str, object]:
    return {"env": env, "baseline": baseline}


def _adjusted(rows: list[dict[str, object]], selection: Selection) -> pd.DataFrame:
    if not rows:
        raise AnalysisError(
            f"A comparison needs trials of {REFERENCE} and of a baseline in one environment, "
            f"but only {', '.join(selection.policies)} is selected: run the others, or ask wider."
        )
    table = pd.DataFrame(rows)
    table["p_adjusted"] = benjamini_hochberg(table["p_value"].tolist())
    return table


def _stream(*names: str) -> np.random.Generator:
    """Return a generator of the row's own: its interval does not depend on the other rows."""
    digest = hashlib.sha256("/".join(names).encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "little"))
