"""Table of a report: each variant with its measures, and its ratios to the reference."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from analysis.data.curves import read_curves
from analysis.data.divergence import DivergenceRule
from analysis.data.trial_selection import Entry
from analysis.report.variants import VariantGroup
from analysis.stats.control import scores_at
from analysis.stats.intervals import mean, standard_error
from analysis.stats.paired_tests import (
    benjamini_hochberg,
    censored_median,
    compare_hitting_times,
    without_ratio,
)
from analysis.stats.trial_scores import final_losses, lasting_steps, mean_losses
from analysis.tables.comparisons import (
    BySeed,
    against_reference,
    loss_of_random_inputs,
    paired,
)
from dopt.coverage import Plane
from dopt.policies.titles import policy_title
from dopt.spec.prequential import system_of
from orchestrate.store import Reader

MEASURES = ("loss", "reachable_loss", "auc", "coverage", "control")
"""Measures by which variants are compared; of coverage more is better, of the others less.

``control`` is the cost of an episode with the model learned so far by that with the true model, at
the first number of steps that the task names; only trials of the environment's task have it. An
episode without a finite cost is in no mean and in no ratio (``control_lost`` pairs), and the worst
in the test.
"""

SAME = "same"
"""Start of the columns that compare with the reference policy under the variant's own setting."""

SAME_MEASURES = ("loss", "reachable_loss", "auc")
"""Measures that are compared under the same setting too."""

SIGNIFICANCE = 0.05
"""Adjusted p below which a report says that a variant is better or worse."""


def tabulate_group(
    reader: Reader, group: VariantGroup, rule: DivergenceRule = DivergenceRule.EXCLUDE
) -> pd.DataFrame:
    """Return one row for each variant of an environment, the reference first."""
    plane = Plane.of(system_of(group.reference.config.config))
    epsilon = loss_of_random_inputs(reader, group.variants, "loss", rule)
    scores = {one.label: _scores(reader, one, plane, rule) for one in group.variants}
    costs = _control_costs(reader, group)
    for label, own in scores.items():
        own["control"] = costs.get(label, {})
    return pd.DataFrame(
        [
            _row(reader, group, one, scores[one.label], scores)
            | _under_same_setting(group, one, scores)
            | _samples(reader, group, one, math.nan if epsilon is None else epsilon, rule)
            for one in group.variants
        ]
    )


def adjust(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Join the tables and adjust each measure's p-values over the whole report."""
    table = pd.concat(tables, ignore_index=True)
    for measure in (*MEASURES, *(f"{SAME}_{one}" for one in SAME_MEASURES), "steps"):
        table[f"{measure}_p_adjusted"] = benjamini_hochberg(table[f"{measure}_p"].tolist())
    return table


def verdict(row: Mapping[str, object], measure: str = "loss") -> str:
    """Return "better" or "worse" than the reference, or "open".

    It is open unless both tell: the test, of ranks and adjusted, and the interval, of the mean.
    """
    p, ratio, low, high = (
        _float(row[f"{measure}_{name}"]) for name in ("p_adjusted", "ratio", "low", "high")
    )
    if not p < SIGNIFICANCE or not (high < 1 or low > 1):
        return "open"
    return "better" if (ratio < 1) != (measure == "coverage") else "worse"


def _float(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def _scores(
    reader: Reader, variant: Entry, plane: Plane, rule: DivergenceRule
) -> dict[str, BySeed]:
    entry = variant
    return {
        "loss": final_losses(reader, entry, "loss", rule).by_seed,
        "reachable_loss": final_losses(reader, entry, "reachable_loss", rule).by_seed,
        "auc": mean_losses(reader, entry, "loss", rule).by_seed,
        "coverage": _coverages(reader, variant, plane),
    }


def _control_costs(reader: Reader, group: VariantGroup) -> dict[str, BySeed]:
    """Return the relative costs of the assessed variants after the first steps of their task."""
    keys = {one.label: one.config.config_key for one in group.assessed}
    steps = {t for key in keys.values() for t in reader.assessments(key, "control_cost").t.tolist()}
    first = min((t for t in steps if t > 0), default=0)
    return {one.label: scores_at(reader, one, first).by_seed for one in group.assessed}


def _coverages(reader: Reader, variant: Entry, plane: Plane) -> BySeed:
    key = variant.config.config_key
    seeds = variant.final_losses()
    return {seed: plane.coverage(reader.trajectory(key, seed).states) for seed in seeds}


def _row(
    reader: Reader,
    group: VariantGroup,
    variant: Entry,
    own: Mapping[str, BySeed],
    scores: Mapping[str, Mapping[str, BySeed]],
) -> dict[str, object]:
    trials = variant.finished
    row: dict[str, object] = {
        "env": group.env,
        "variant": variant.label,
        "policy": variant.config.policy,
        "policy_label": policy_title(variant.config.policy),
        "model": variant.config.model,
        "learner": variant.config.learner,
        "path": variant.config.config["path"],
        "dt": variant.config.config["env"]["dt"],
        "n": len(own["loss"]),
        "n_diverged": sum(trial.status == "diverged" for trial in trials),
        "plan_us": _typical(reader, variant, "plan_us"),
        "learn_us": _typical(reader, variant, "learn_us"),
    }
    reference = scores[group.reference.label]
    for measure in MEASURES:
        values = np.array(list(own[measure].values()))
        values = values[np.isfinite(values)]
        row[measure] = float(mean(values)) if len(values) else math.nan
        row[f"{measure}_2se"] = 2 * float(standard_error(values)) if len(values) else math.nan
        row |= _against(own[measure], reference[measure], group.env, variant.label, measure)
    row["control_lost"] = without_ratio(*paired(own["control"], reference["control"]))
    return row


def _under_same_setting(
    group: VariantGroup, variant: Entry, scores: Mapping[str, Mapping[str, BySeed]]
) -> dict[str, object]:
    """Compare with the reference policy under the same model and learner; NaN where it has none."""
    reference = group.reference_with_setting_of(variant)
    own = scores[variant.label]
    with_setting = own if reference is None else scores[reference.label]
    row: dict[str, object] = {
        f"{SAME}_reference": "" if reference in (None, variant) else reference.label
    }
    for measure in SAME_MEASURES:
        found = _against(own[measure], with_setting[measure], group.env, variant.label, measure)
        row |= {f"{SAME}_{column}": value for column, value in found.items()}
    return row


def _samples(
    reader: Reader, group: VariantGroup, variant: Entry, epsilon: float, rule: DivergenceRule
) -> dict[str, float]:
    """Return how many inputs it takes until the loss stays at most ε.

    They are the median over the trials, the share of those that get there, and the p of the sign
    test against the reference. A trial that does not get there is censored: later than any that
    does.
    """
    known = not math.isnan(epsilon)
    own, reference = (
        lasting_steps(reader, one, "loss", rule, epsilon).by_seed
        for one in (variant, group.reference)
    )
    steps = np.array(list(own.values()))
    compared = known and variant is not group.reference
    return {
        "epsilon": epsilon,
        "horizon": variant.config.horizon,
        "steps": censored_median(steps) if known else math.nan,
        "reached": float(np.mean(np.isfinite(steps))) if known and len(steps) else math.nan,
        "steps_p": _hitting_time_p(own, reference) if compared else math.nan,
    }


def _hitting_time_p(own: BySeed, reference: BySeed) -> float:
    return compare_hitting_times(*paired(own, reference)).p_value


def _against(
    own: BySeed, reference: BySeed, env: str, variant: str, measure: str
) -> dict[str, float]:
    """Return the ratio to the reference; nothing for the reference itself."""
    columns = ("ratio", "low", "high", "improvement", "p")
    if own is reference:
        return {f"{measure}_{column}": math.nan for column in columns}
    found = against_reference(own, reference, env, variant, measure)
    values = (found.ratio, found.low, found.high, found.improvement, found.p_value)
    return {f"{measure}_{column}": value for column, value in zip(columns, values, strict=True)}


def _typical(reader: Reader, variant: Entry, column: str) -> float:
    """Return the median over all steps of all trials."""
    values = read_curves(reader, variant, column).values
    return float(np.nanmedian(values)) if np.isfinite(values).any() else math.nan
