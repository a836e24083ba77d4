"""The numbers of a report: each variant against the reference, paired over the seeds they share."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.comparisons import loss_of_random_inputs
from analysis.control import scores_at
from analysis.divergence import DivergenceRule
from analysis.figures.style import policy_style
from analysis.measures import final_losses, lasting_steps, mean_losses
from analysis.paired import benjamini_hochberg, censored_median, compare, race, without_ratio
from analysis.reading import read_curves
from analysis.report.variants import Field, Variant
from analysis.statistics import mean, standard_error
from dopt.coverage import Plane
from dopt.systems import system_from_mapping
from orchestrate.store import Reader

Array = npt.NDArray[np.float64]
Scores = Mapping[int, float]

MEASURES = ("loss", "reachable_loss", "auc", "coverage", "control")
"""What variants are compared by; of coverage more is better, of the others less.

``control`` is the cost of an episode with the model learned so far by that with the true model, at
the first number of steps that the task names; only trials of the environment's task have it. An
episode without a finite cost is in no mean and in no ratio (``control_lost`` pairs), and the worst
in the test.
"""

LEVEL = 0.05
"""Adjusted p below which a report says that a variant is better or worse."""


def tabulate_field(
    reader: Reader, field: Field, rule: DivergenceRule = DivergenceRule.EXCLUDE
) -> pd.DataFrame:
    """Return one row for each variant of an environment, the reference first."""
    plane = Plane.of(system_from_mapping(field.reference.entry.cell.config["env"]))
    entries = tuple(one.entry for one in field.variants)
    epsilon = loss_of_random_inputs(reader, entries, "loss", rule)
    scores = {one.label: _scores(reader, one, plane, rule) for one in field.variants}
    costs = _control_costs(reader, field)
    for label, own in scores.items():
        own["control"] = costs.get(label, {})
    return pd.DataFrame(
        [
            _row(reader, field, one, scores[one.label], scores)
            | _samples(reader, field, one, math.nan if epsilon is None else epsilon, rule)
            for one in field.variants
        ]
    )


def adjust(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Join the tables and adjust each measure's p-values over the whole report."""
    table = pd.concat(tables, ignore_index=True)
    for measure in (*MEASURES, "steps"):
        table[f"{measure}_p_adjusted"] = benjamini_hochberg(table[f"{measure}_p"].tolist())
    return table


def verdict(row: Mapping[str, object], measure: str = "loss") -> str:
    """Return "better" or "worse" than the reference, or "open".

    It is open unless both tell: the test, of ranks and adjusted, and the interval, of the mean.
    """
    p, ratio, low, high = (
        _float(row[f"{measure}_{name}"]) for name in ("p_adjusted", "ratio", "low", "high")
    )
    if not p < LEVEL or not (high < 1 or low > 1):
        return "open"
    return "better" if (ratio < 1) != (measure == "coverage") else "worse"


def _float(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def _scores(
    reader: Reader, variant: Variant, plane: Plane, rule: DivergenceRule
) -> dict[str, Scores]:
    entry = variant.entry
    return {
        "loss": final_losses(reader, entry, "loss", rule).by_seed,
        "reachable_loss": final_losses(reader, entry, "reachable_loss", rule).by_seed,
        "auc": mean_losses(reader, entry, "loss", rule).by_seed,
        "coverage": _coverages(reader, variant, plane),
    }


def _control_costs(reader: Reader, field: Field) -> dict[str, Scores]:
    """Return the relative costs of the assessed variants after the first steps of their task."""
    keys = {one.label: one.entry.cell.config_key for one in field.assessed}
    steps = {t for key in keys.values() for t in reader.assessments(key, "control_cost").t.tolist()}
    first = min((t for t in steps if t > 0), default=0)
    return {one.label: scores_at(reader, one.entry, first).by_seed for one in field.assessed}


def _coverages(reader: Reader, variant: Variant, plane: Plane) -> Scores:
    key = variant.entry.cell.config_key
    seeds = variant.entry.final_losses()
    return {seed: plane.coverage(reader.trajectory(key, seed).states) for seed in seeds}


def _row(
    reader: Reader,
    field: Field,
    variant: Variant,
    own: Mapping[str, Scores],
    scores: Mapping[str, Mapping[str, Scores]],
) -> dict[str, object]:
    trials = variant.entry.finished
    row: dict[str, object] = {
        "env": field.env,
        "variant": variant.label,
        "policy": variant.entry.cell.policy,
        "policy_label": policy_style(variant.entry.cell.policy).label,
        "model": variant.entry.cell.model,
        "learner": variant.entry.cell.learner,
        "path": variant.entry.cell.config["path"],
        "dt": variant.entry.cell.config["env"]["dt"],
        "n": len(own["loss"]),
        "n_diverged": sum(trial.status == "diverged" for trial in trials),
        "plan_us": _typical(reader, variant, "plan_us"),
        "learn_us": _typical(reader, variant, "learn_us"),
    }
    reference = scores[field.reference.label]
    for measure in MEASURES:
        values = np.array(list(own[measure].values()))
        values = values[np.isfinite(values)]
        row[measure] = float(mean(values)) if len(values) else math.nan
        row[f"{measure}_2se"] = 2 * float(standard_error(values)) if len(values) else math.nan
        row |= _against(own[measure], reference[measure], field.env, variant.label, measure)
    row["control_lost"] = without_ratio(*_paired(own["control"], reference["control"]))
    return row


def _samples(
    reader: Reader, field: Field, variant: Variant, epsilon: float, rule: DivergenceRule
) -> dict[str, float]:
    """Return how many inputs it takes until the loss stays at most ε.

    They are the median over the trials, the share of those that get there, and the p of the sign
    test against the reference. A trial that does not get there is censored: later than any that
    does.
    """
    known = not math.isnan(epsilon)
    own, reference = (
        lasting_steps(reader, one.entry, "loss", rule, epsilon).by_seed
        for one in (variant, field.reference)
    )
    steps = np.array(list(own.values()))
    compared = known and variant is not field.reference
    return {
        "epsilon": epsilon,
        "horizon": variant.entry.cell.horizon,
        "steps": censored_median(steps) if known else math.nan,
        "reached": float(np.mean(np.isfinite(steps))) if known and len(steps) else math.nan,
        "steps_p": race(*_paired(own, reference)).p_value if compared else math.nan,
    }


def _against(own: Scores, reference: Scores, *names: str) -> dict[str, float]:
    """Return the ratio to the reference over the shared seeds; nothing for the reference itself."""
    measure = names[-1]
    columns = ("ratio", "low", "high", "improvement", "p")
    if own is reference:
        return {f"{measure}_{column}": math.nan for column in columns}
    found = compare(*_paired(own, reference), _stream(*names))
    values = (found.ratio, found.low, found.high, found.improvement, found.p_value)
    return {f"{measure}_{column}": value for column, value in zip(columns, values, strict=True)}


def _paired(own: Scores, reference: Scores) -> tuple[Array, Array]:
    """Return the scores of the two on the seeds that they share."""
    seeds = sorted(set(own) & set(reference))
    ours, theirs = (np.array([one[seed] for seed in seeds], float) for one in (own, reference))
    return ours, theirs


def _typical(reader: Reader, variant: Variant, column: str) -> float:
    """Return the median over all steps of all trials."""
    values = read_curves(reader, variant.entry, column).values
    return float(np.nanmedian(values)) if np.isfinite(values).any() else math.nan


def _stream(*names: str) -> np.random.Generator:
    """Return a generator of the row's own, so that its interval does not depend on the others."""
    digest = hashlib.sha256("/".join(("report", *names)).encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "little"))
