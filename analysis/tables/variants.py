"""Variants of an environment, everything that was run in it, as rows of a report.

Figures and tables compare policies under one setting of model and learner. A report compares the
settings too: a variant is a policy together with what sets it apart from the others of its name.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from analysis.data.matching import AnalysisError, Filter, accepted, latest_sources, nearness
from analysis.data.samples import coverages, read_curves, sample_losses
from analysis.data.selection import (
    Entry,
    environment_rank,
    labels_of,
    one_each,
    one_world,
    policy_rank,
    section_text,
)
from analysis.stats.curves import centre, mean_columns
from analysis.stats.scores import (
    BySeed,
    benjamini_hochberg,
    censored_median,
    common_task,
    compare_hitting_times,
    final_losses,
    geometric_mean,
    last_passage,
    mcnemar,
    mean_losses,
    measured,
    relative_costs,
    scores_at,
    steps_to,
    success_rate,
    task_of,
    true_model,
    usable,
    without_ratio,
)
from analysis.style import but_diverged
from analysis.tables.comparisons import against_reference, loss_of_random_inputs, paired
from dopt.assessment import Plane
from dopt.errors import counted
from dopt.policies import policy_title
from dopt.spec.config import difference
from dopt.spec.trial import is_prequential, system_of
from orchestrate.store import Assessments, Reader

_SETTING = ("model", "learner", "limits")

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

TRUTH = "true model"
SUCCESS, FREE_RUN = "control_success", "free_run_error"
ESTIMATES = ("success", "success_low", "success_high", "cost", "cost_low", "cost_high")
Row = Mapping[str, Any]
ByMeasure = Mapping[str, BySeed]


@dataclass(frozen=True)
class VariantGroup:
    """The variants of one environment, the reference first, and what was left out.

    ``task`` is the one by which control is compared, as JSON, None where no trial was assessed.
    """

    env: str
    variants: tuple[Entry, ...]
    notes: tuple[str, ...] = ()
    task: str | None = None

    @property
    def reference(self) -> Entry:
        return self.variants[0]

    @property
    def assessed(self) -> tuple[Entry, ...]:
        """The variants whose control is compared: those that were assessed by the common task."""
        if self.task is None:
            return ()
        return tuple(one for one in self.variants if task_of(one) == self.task)

    def reference_with_setting_of(self, variant: Entry) -> Entry | None:
        """Return the reference policy with the model, learner and limits of a variant, if any.

        Among several it is the one nearest to the defaults.
        """
        setting = _setting(variant)
        same = [
            one
            for one in self.variants
            if one.config.policy == self.reference.config.policy and _setting(one) == setting
        ]
        return max(same, key=lambda one: nearness(one.config), default=None)


def variant_groups(reader: Reader, wanted: Filter) -> list[VariantGroup]:
    """Return the variants of every environment that has the reference policy and another.

    Explorations are left out: each loss is an error on the path of that exploration.

    Raises
    ------
    AnalysisError
        If no environment has both, or a name that was asked for is not stored.
    """
    current = [config for config in accepted(reader, wanted) if not is_prequential(config.config)]
    configs = latest_sources(reader, current)
    entries = [Entry(config, tuple(reader.trials(config.config_key))) for config in configs]
    names = sorted({config.env for config in configs}, key=environment_rank)
    found = [
        _group(env, [entry for entry in entries if entry.config.env == env], wanted.reference)
        for env in names
    ]
    whole = [group for group in found if group is not None]
    if not whole:
        raise AnalysisError(
            f"A report needs trials of {wanted.reference} and of another variant in one "
            f"environment, but {reader.safe_url} has none: run 'python orchestrate/launch.py -m "
            f"experiment=beyond', or choose another --reference."
        )
    return whole


def _group(env: str, entries: Sequence[Entry], policy: str) -> VariantGroup | None:
    world = one_world(entries)
    task = common_task(world)
    kept = one_each(
        world, lambda one: (task_of(one) == task, len(one.trials), "assess" in one.config.config)
    )
    references = [entry for entry in kept if entry.config.policy == policy]
    if not references or len(kept) < 2:
        return None
    company = Counter(map(_setting, kept))
    reference = max(references, key=lambda one: (company[_setting(one)], *nearness(one.config)))
    words = labels_of(entry.config for entry in kept)
    variants = [replace(entry, label=label) for entry, label in zip(kept, words, strict=True)]
    first = next(one for one in variants if one.config is reference.config)
    rest = [one for one in variants if one is not first]
    rest.sort(key=lambda one: (policy_rank(one.config.policy), one.label))
    left = len(entries) - len(kept)
    notes = [f"{left} configurations of another env section, task or fewer trials"] if left else []
    notes += [*_of_unequal_seeds([first, *rest]), *_of_other_tasks([first, *rest], task)]
    return VariantGroup(env, (first, *rest), tuple(notes), task)


def _of_unequal_seeds(variants: Sequence[Entry]) -> Iterator[str]:
    """Say how many seeds the variants have, where they differ."""
    numbers = Counter(len({trial.seed for trial in one.trials}) for one in variants)
    if len(numbers) > 1:
        counts = ", ".join(
            f"{n} seeds: {counted(count, 'variant')}" for n, count in sorted(numbers.items())
        )
        yield f"{counts}; a ratio is over the seeds that both variants of it have"


def _of_other_tasks(variants: Sequence[Entry], task: str | None) -> Iterator[str]:
    """Say which variants are not in the section on control, and in what their task differs."""
    others: dict[str, list[str]] = {}
    for one in variants:
        own = task_of(one)
        if own is not None and own != task:
            others.setdefault(own, []).append(one.label)
    for other, names in others.items():
        path, (value, usual) = difference([json.loads(other), json.loads(task or "{}")])
        yield (
            f"control with {'; '.join(names)}: assessed by another task than most trials "
            f"({path} = {value} instead of {usual}), so these costs and successes are not compared"
        )


def _setting(entry: Entry) -> tuple[str, ...]:
    return tuple(section_text(entry, name) for name in _SETTING)


def tabulate_group(reader: Reader, group: VariantGroup) -> pd.DataFrame:
    """Return one row for each variant of an environment, the reference first."""
    found = loss_of_random_inputs(reader, group.variants, "loss")
    epsilon = math.nan if found is None else found
    scores = _scores(reader, group, epsilon)
    return pd.DataFrame(
        [_variant_row(reader, group, one, scores, epsilon) for one in group.variants]
    )


def adjust(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Join the tables and adjust each measure's p-values over the whole report."""
    table = pd.concat(tables, ignore_index=True)
    for measure in (*MEASURES, *(f"{SAME}_{one}" for one in SAME_MEASURES), "steps"):
        table[f"{measure}_p_adjusted"] = benjamini_hochberg(table[f"{measure}_p"].tolist())
    return table


def verdict(row: Row, measure: str = "loss") -> str:
    """Return "better" or "worse" than the reference, or "open".

    It is open unless both tell: the test, of ranks and adjusted, and the interval, of the mean.
    """
    names = ("p_adjusted", "ratio", "low", "high")
    p, ratio, low, high = (row[f"{measure}_{name}"] for name in names)
    if not p < SIGNIFICANCE or not (high < 1 or low > 1):
        return "open"
    return "better" if (ratio < 1) != (measure == "coverage") else "worse"


def _scores(reader: Reader, group: VariantGroup, epsilon: float) -> dict[str, dict[str, BySeed]]:
    """Return the scores of each variant, by its label and by measure.

    ``control`` is the relative cost after the first steps of the task; ``steps`` are the inputs
    until the loss stays at most ε, inf where it does not.
    """
    plane = Plane.of(system_of(group.reference.config.config))
    assessed = {one.label: one.config.config_key for one in group.assessed}
    tasks = [reader.assessments(key, "control_cost").t.tolist() for key in assessed.values()]
    first = min((t for steps in tasks for t in steps if t > 0), default=0)
    return {
        one.label: {
            "loss": final_losses(reader, one, "loss"),
            "reachable_loss": final_losses(reader, one, "reachable_loss"),
            "auc": mean_losses(reader, one, "loss"),
            "coverage": coverages(reader, one, plane),
            "control": scores_at(reader, one, first) if one.label in assessed else {},
            "steps": steps_to(reader, one, "loss", epsilon, last_passage),
        }
        for one in group.variants
    }


def _variant_row(
    reader: Reader,
    group: VariantGroup,
    variant: Entry,
    scores: Mapping[str, ByMeasure],
    epsilon: float,
) -> dict[str, object]:
    config, own = variant.config, scores[variant.label]
    reference = scores[group.reference.label]
    row: dict[str, object] = {
        "env": group.env,
        "variant": variant.label,
        "policy": config.policy,
        "policy_label": policy_title(config.policy),
        "model": config.model,
        "learner": config.learner,
        "path": config.config["path"],
        "dt": config.config["env"]["dt"],
        "n": len(own["loss"]),
        "n_diverged": variant.n_diverged,
        "plan_us": _typical(reader, variant, "plan_us"),
        "learn_us": _typical(reader, variant, "learn_us"),
    }
    for measure in MEASURES:
        values = np.array(list(own[measure].values()))
        row |= mean_columns(measure, values[np.isfinite(values)])
        row |= _against(own, reference, variant, measure)
    if sampled := sample_losses(reader, variant):
        row |= mean_columns("sample_loss", np.array([*sampled.values()]))
    row["control_lost"] = without_ratio(*paired(own["control"], reference["control"]))
    same = group.reference_with_setting_of(variant) or variant
    row[f"{SAME}_reference"] = "" if same is variant else same.label
    for measure in SAME_MEASURES:  # NaN where the reference policy has no such setting
        row |= _against(own, scores[same.label], variant, measure, f"{SAME}_")
    return row | {"epsilon": epsilon, "horizon": config.horizon} | _race(own, reference, epsilon)


def _race(own: ByMeasure, reference: ByMeasure, epsilon: float) -> dict[str, float]:
    """Return the median steps to ε, the share of trials that get there, and p of the sign test.

    A trial that does not get there is censored: later than any that does. NaN without an ε.
    """
    steps = np.array([] if math.isnan(epsilon) else list(own["steps"].values()))
    found = compare_hitting_times(*paired(own["steps"], reference["steps"]))
    return {
        "steps": censored_median(steps),
        "reached": float(np.mean(np.isfinite(steps))) if len(steps) else math.nan,
        "steps_p": math.nan if own is reference or math.isnan(epsilon) else found.p_value,
    }


def _against(
    own: ByMeasure, reference: ByMeasure, variant: Entry, measure: str, prefix: str = ""
) -> dict[str, float]:
    """Return the ratio to the reference; NaN for the reference itself."""
    names = variant.config.env, variant.label, measure
    pair = own[measure], reference[measure]
    found = None if own is reference else against_reference(*pair, *names)
    return {
        f"{prefix}{measure}_{name.removesuffix('_value')}": getattr(found, name, math.nan)
        for name in ("ratio", "low", "high", "improvement", "p_value")
    }


def _typical(reader: Reader, variant: Entry, column: str) -> float:
    """Return the median over all steps of all trials."""
    values = read_curves(reader, variant, column).values
    return float(np.nanmedian(values)) if np.isfinite(values).any() else math.nan


def tabulate_control_of(reader: Reader, groups: Sequence[VariantGroup]) -> pd.DataFrame | None:
    """Return one row for each environment, variant and number of steps, None without a task."""
    rows = [row for group in groups if group.assessed for row in _control_rows(reader, group)]
    if not rows:
        return None
    table = pd.DataFrame(rows)
    table["success_p_adjusted"] = benjamini_hochberg(table["success_p"].tolist())
    return table


def _control_rows(reader: Reader, group: VariantGroup) -> Iterator[dict[str, object]]:
    """Yield a row for each assessed variant and number of steps, all of one moment.

    Success: share with its Wilson interval. Cost: geometric mean of the cost by the true model's
    with Student's interval. Lost: episodes in no mean of costs.
    """
    steps: set[int] = set()
    reference = None
    with reader.moment() as moment:
        truth = true_model(moment, group.assessed)
        for one in group.assessed:
            (own,) = measured(moment, one, SUCCESS)
            reference = own if one is group.reference else reference
            ratios = relative_costs(moment, one).values
            losses = read_curves(moment, one, "loss").values
            free_runs = moment.assessments(one.config.config_key, FREE_RUN)
            for k, t in enumerate(own.t.tolist()):
                reached = np.isfinite(own.values[:, k])
                estimates = *success_rate(own.values[:, k]), *geometric_mean(ratios[:, k])
                yield {
                    **{"env": group.env, "variant": one.label, "t": t, "n": int(np.sum(reached))},
                    **dict(zip(ESTIMATES, estimates, strict=True)),
                    "lost": int(np.sum(reached & ~usable(ratios[:, k]))),
                    "success_p": _test(own, reference, t),
                    "loss": geometric_mean(losses[:, t - 1])[0] if t else math.nan,
                    **_free_run(free_runs, t, int(np.sum(reached))),
                    "described": but_diverged(len(own.seeds), int(np.sum(own.diverged))),
                }
            steps |= set(own.t.tolist())
    yield from (_truth(group.env, truth, t) for t in sorted(steps))


def _truth(env: str, truth: Mapping[str, float], t: int) -> dict[str, object]:
    """Return a row of the true model: the same after any number of steps, its cost the unit."""
    return {
        **{"env": env, "variant": TRUTH, "t": t},
        **truth,
        "cost": 1.0 if truth["lost"] < truth["n"] else math.nan,
        "described": str(truth["n"]),
    }


def _test(own: Assessments, reference: Assessments | None, t: int) -> float:
    """Return p of the successes after t explored steps, over the seeds that reached them."""
    if reference is None or own is reference or t == 0:
        return math.nan
    return mcnemar(*paired(_at(own, t), _at(reference, t)))


def _at(found: Assessments, t: int) -> dict[int, float]:
    """Return the number of each seed that reached t steps."""
    rows, columns = np.nonzero(np.isfinite(found.values) & (found.t == t))
    return dict(zip(found.seeds[rows].tolist(), found.values[rows, columns].tolist(), strict=True))


def _free_run(found: Assessments, t: int, reached: int) -> dict[str, object]:
    """Return the mean error after t steps, and of how many trials it is not finite."""
    errors = found.values[:, found.t == t]
    finite = errors[np.isfinite(errors)]
    return {"free_run": float(centre(finite)), "free_run_lost": max(0, reached - len(finite))}
