"""Paired comparisons: every variant against one reference, over the seeds that they share.

All tables and the report take their ratios from :func:`against_reference`. A ratio is
always variant / reference: below 1 the variant has the lower value. An environment has one
reference; where variants are grouped by the policy and other settings, each one is compared with
the reference policy under the same other settings (:func:`references`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial

import numpy as np
import pandas as pd

from analysis.data.matching import AnalysisError, nearness
from analysis.data.samples import sample_losses
from analysis.data.selection import Entry, Selection
from analysis.stats.curves import Statistic, centre, mean_columns, stratified_mean
from analysis.stats.scores import (
    BySeed,
    Comparison,
    Measure,
    benjamini_hochberg,
    compare,
    compare_hitting_times,
    final_losses,
    mean_losses,
    steps_to,
    values_of,
)
from dopt.types import Array
from orchestrate.store import Reader

Score = Callable[[Reader, Entry, str], BySeed]

Judged = Mapping[str, object]
"""Columns that compare a variant with its reference."""

EPSILON_POLICY = "random"
"""The policy whose median final loss is the ε that others are to reach."""

_SCORES: dict[Measure, Score] = {Measure.FINAL: final_losses, Measure.AUC: mean_losses}
_ENDS = {"ratio": "centre", "low": "low", "high": "high"}
Ratios = tuple[Entry, Entry, Array]
"""A variant, its reference, and the logarithms of the ratios on the seeds that they share."""


def against_reference(
    own: BySeed, reference: BySeed, env: str, variant: str, measure: str
) -> Comparison:
    """Return how a variant compares with the reference on the seeds that they share.

    The bootstrap has its own random stream for each environment, label and measure. A label
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
    reader: Reader, selection: Selection, column: str = "loss", measure: Measure = Measure.FINAL
) -> pd.DataFrame:
    """Return the ratio of losses, one row for each environment and variant.

    ``p_adjusted`` is the Benjamini-Hochberg adjustment of the Wilcoxon p over the whole table.
    """
    name = "auc" if measure is Measure.AUC else column
    rows: list[dict[str, object]] = []
    selection = selection.simulated()

    def judge(own: BySeed, other: BySeed, env: str, variant: str) -> Judged:
        return asdict(against_reference(own, other, env, variant, name))

    for env in selection.environments:
        scores = [_SCORES[measure](reader, entry, column) for entry in selection.of(env)]
        rows += _rows(selection, env, scores, judge)
    return _adjusted(rows, selection)


def compare_steps(
    reader: Reader, selection: Selection, column: str = "loss", epsilon: float | None = None
) -> pd.DataFrame:
    """Return who reaches the loss ε first, one row for each environment and variant.

    Without ``epsilon`` it is the median final loss of random inputs, so that the question is when a
    policy knows what random inputs know at the end; environments without them are left out.

    Raises
    ------
    AnalysisError
        If there is nothing to compare.
    """
    rows: list[dict[str, object]] = []
    selection = selection.simulated()
    for env in selection.environments:
        entries = selection.of(env)
        threshold = loss_of_random_inputs(reader, entries, column) if epsilon is None else epsilon
        if threshold is None:
            continue
        scores = [steps_to(reader, entry, column, threshold) for entry in entries]
        facts = {"epsilon": threshold, "horizon": entries[0].config.horizon}
        rows += _rows(selection, env, scores, partial(_race, facts))
    if not rows and selection.compared().entries and len(selection.entries) > 1:
        raise AnalysisError(
            f"Steps to a loss need that loss or trials of {EPSILON_POLICY}, whose median final "
            f"loss it would be, but neither is given: add --epsilon, or select {EPSILON_POLICY} "
            f"too."
        )
    return _adjusted(rows, selection)


def loss_of_random_inputs(reader: Reader, entries: Iterable[Entry], column: str) -> float | None:
    """Return the median final loss of random inputs, None without such trials.

    Of several configurations the one nearest to the defaults is taken.
    """
    found = [one for one in entries if one.config.policy == EPSILON_POLICY and one.final_losses()]
    if not found:
        return None
    usual = max(found, key=lambda one: nearness(one.config))
    return float(np.median(values_of(final_losses(reader, usual, column))))


def references(selection: Selection, env: str) -> Iterator[tuple[Entry, Entry, bool]]:
    """Yield each variant of an environment, its reference, and whether they share a group.

    A group is made of the entries that have the same values of all settings of ``group_by`` but the
    policy. If the reference policy has a final loss in a group, it is the reference of the others
    in the group. Everything else is compared with the reference of the environment.
    """
    overall = selection.reference_of(env)
    if overall is None:
        return
    entries = selection.of(env)
    of_group = {}
    if selection.reference == overall.config.policy and len(_other_keys(selection)) > 0:
        named = [one for one in entries if one.config.policy == selection.reference]
        of_group = {_group(one, selection): one for one in named if one.final_losses()}
    for one in entries:
        reference = of_group.get(_group(one, selection))
        if reference is not None and reference is not one:
            yield one, reference, True
        elif reference is one and any(
            other is not one and _group(other, selection) == _group(one, selection)
            for other in entries
        ):
            continue  # the reference of its group
        elif one is not overall:
            yield one, overall, False


def _other_keys(selection: Selection) -> tuple[str, ...]:
    """Return the settings other than the policy by which entries that name it are grouped."""
    keys = selection.group_by
    return tuple(key for key in keys if key != "policy") if "policy" in keys else ()


def _group(entry: Entry, selection: Selection) -> tuple[object, ...]:
    pairs = zip(selection.group_by, entry.group, strict=True)
    return tuple(value for key, value in pairs if key != "policy")


def _rows(
    selection: Selection,
    env: str,
    scores: Sequence[BySeed],
    judge: Callable[[BySeed, BySeed, str, str], Judged],
) -> Iterator[dict[str, object]]:
    """Yield a row for each variant of an environment: names, what ``judge`` says, and counts.

    It is given the scores of the variant and of its reference, the environment and the label.
    """
    labels = (entry.label for entry in selection.of(env))
    found = dict(zip(labels, scores, strict=True))
    keys = _other_keys(selection)
    for entry, other, same_group in references(selection, env):
        names = {"env": env, "policy": entry.config.policy, "variant": entry.label}
        names["reference"] = other.label
        if keys:
            names["same"] = ", ".join(keys) if same_group else ""
        judged = judge(found[entry.label], found[other.label], env, entry.label)
        yield {**names, **judged, "n_diverged": entry.n_diverged + other.n_diverged}


def _race(facts: Judged, own: BySeed, reference: BySeed, *_: str) -> Judged:
    return {**facts, **asdict(compare_hitting_times(*paired(own, reference)))}


def _adjusted(rows: list[dict[str, object]], selection: Selection) -> pd.DataFrame:
    if not rows:
        raise nothing_to_compare(selection)
    table = pd.DataFrame(rows)
    table["p_adjusted"] = benjamini_hochberg(table["p_value"].tolist())
    return table


def nothing_to_compare(selection: Selection) -> AnalysisError:
    """Return the error for a selection without a pair of simulated trials."""
    selected = ", ".join(selection.labels) or "no simulated trial"
    return AnalysisError(
        f"A comparison needs trials of the reference {selection.reference} and of another variant "
        f"that are done, of one environment and seed, but the selection ({selected}) has none: run "
        f"them, ask wider, or choose another --reference."
    )


def aggregate(reader: Reader, selection: Selection) -> pd.DataFrame:
    """Return the ratio of final losses over all systems, one row for each variant.

    It is the geometric mean over systems of the geometric means over shared seeds of variant /
    reference, with the interval of :func:`analysis.stats.curves.stratified_mean`. Every system
    counts alike. A variant is compared over those that have it: ``systems``.

    Raises
    ------
    AnalysisError
        If the reference shares no seed with another variant.
    """
    found: dict[str, list[Ratios]] = {}
    selection = selection.simulated()
    for env in selection.environments:
        for own, reference, _ in references(selection, env):
            logs = _log_ratios(*(final_losses(reader, one, "loss") for one in (own, reference)))
            if len(logs):
                found.setdefault(own.label, []).append((own, reference, logs))
    if not found:
        raise nothing_to_compare(selection)
    return pd.DataFrame([_aggregate_row(variant, pairs) for variant, pairs in found.items()])


def _aggregate_row(variant: str, pairs: list[Ratios]) -> dict[str, object]:
    logs = [ratios for *_, ratios in pairs]
    found = stratified_mean(logs)
    return {
        "variant": variant,
        "reference": pairs[0][1].label,
        "systems": ", ".join(own.config.env for own, *_ in pairs),
        **{name: float(np.exp(getattr(found, part))) for name, part in _ENDS.items()},
        "n_pairs": sum(map(len, logs)),
        "n_diverged": sum(own.n_diverged + reference.n_diverged for own, reference, _ in pairs),
    }


def _log_ratios(own: BySeed, reference: BySeed) -> Array:
    """Return the logarithms of the ratios (n,); NaN for a loss that has none."""
    ours, theirs = paired(own, reference)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs: Array = np.log(ours / theirs)
    return np.where(np.isfinite(logs), logs, np.nan)


def summarise(reader: Reader, selection: Selection) -> pd.DataFrame:
    """Return centres of the final losses, one row for each environment and policy.

    For both losses the mean with two standard errors, the median and the interquartile mean; and
    the mean of the sample losses where some are stored.
    """
    return pd.DataFrame([_summary(reader, entry) for entry in selection.entries])


def _summary(reader: Reader, entry: Entry) -> dict[str, object]:
    scores = {name: final_losses(reader, entry, name) for name in ("loss", "reachable_loss")}
    row: dict[str, object] = {"env": entry.config.env, "policy": entry.config.policy}
    row["label"] = entry.label
    for name, found in scores.items():
        values = values_of(found)
        row |= mean_columns(name, values)
        row[f"{name}_median"] = float(centre(values, Statistic.MEDIAN))
        row[f"{name}_iqm"] = float(centre(values, Statistic.IQM))
    if sampled := sample_losses(reader, entry):
        row |= mean_columns("sample_loss", np.array([*sampled.values()]))
    return row | {"n": len(scores["loss"]), "n_diverged": entry.n_diverged}
