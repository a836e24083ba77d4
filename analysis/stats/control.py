"""Figure 5 as numbers: control with the learned model against explored steps.

Each trial that was assessed gives two numbers after some of its steps: whether the episode that its
model planned succeeded, and what it cost beside the true model under the same planner, noise and
draws. An episode without a finite cost is lost: it counts in the share of successes, and in no mean
of costs, so that it is counted beside each.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.data.matching import choose
from analysis.data.selection import (
    Entry,
    Selection,
    environment_rank,
    labelled,
    policy_rank,
    unfinished,
)
from analysis.stats.intervals import CONFIDENCE, band
from analysis.stats.scores import Scores
from analysis.style import but_diverged, but_lost
from orchestrate.store import Assessments, Reader

Array = npt.NDArray[np.float64]

Interval = tuple[float, float, float]
"""Centre, low and high."""

Estimate = Callable[[Array], Interval]


@dataclass(frozen=True)
class TrueModel:
    """Success of the planner with the true model in an environment: the ceiling of the others.

    ``n`` seeds, the share of successes with its Wilson interval of 95 %, and how many of the
    episodes have no finite cost. NaN without seeds.
    """

    n: int
    success: float
    success_low: float
    success_high: float
    lost: int


@dataclass(frozen=True)
class ControlCurve:
    """Success and cost of the models of one policy in one environment, after k numbers of steps.

    Attributes
    ----------
    t, n : (k,)
        Explored steps, and trials that reached them.
    success, success_low, success_high : (k,)
        Share of successful episodes, with its Wilson interval of 95 %.
    cost, cost_low, cost_high : (k,)
        Geometric mean of the cost by the true model's, with Student's interval of 95 %.
    lost : (k,)
        Episodes of the n that are in no mean of costs: of no finite cost, their own or the true
        model's of the same seed.
    truth : TrueModel
        Of the seeds of all policies in the environment.
    described : str
        Number of trials, and how many diverged.
    """

    env: str
    policy: str
    t: npt.NDArray[np.int64]
    n: npt.NDArray[np.int64]
    success: Array
    success_low: Array
    success_high: Array
    cost: Array
    cost_low: Array
    cost_high: Array
    lost: npt.NDArray[np.int64]
    truth: TrueModel
    described: str

    @property
    def counts(self) -> str:
        """The number of trials, and of the episodes that were lost after any of the steps."""
        return but_lost(self.described, int(np.sum(self.lost)))


def control_part(selection: Selection) -> Selection:
    """Return the entries with a task, in each environment the task with most trials."""
    asked = [entry for entry in selection.stored if task_of(entry)]
    chosen: list[Entry] = []
    for env in dict.fromkeys(entry.config.env for entry in asked):
        chosen += _of_one_task(
            [entry for entry in asked if entry.config.env == env], selection.reference
        )
    chosen.sort(key=lambda e: (environment_rank(e.config.env), policy_rank(e.config.policy)))
    entries = tuple(labelled(chosen))
    notes = unfinished(
        chosen, lambda one: f"{one.env} × {one.policy}", "trials with a task not finished"
    )
    return replace(selection, entries=entries, gaps=(), notes=tuple(notes), stored=entries)


def _of_one_task(entries: list[Entry], reference: str) -> list[Entry]:
    most = common_task(entries)
    same = {entry.config.config_key: entry for entry in entries if task_of(entry) == most}
    chosen = choose((entry.config for entry in same.values()), reference)
    return [same[config.config_key] for config in chosen]


def common_task(entries: Iterable[Entry]) -> str | None:
    """Return the task by which most trials were assessed, None without one.

    Costs and successes of different tasks are not compared.
    """
    totals: Counter[str] = Counter()
    for entry in entries:
        task = task_of(entry)
        if task is not None:
            totals[task] += len(entry.trials)
    return max(totals, key=lambda task: (totals[task], task)) if totals else None


def task_of(entry: Entry) -> str | None:
    """Return the task by which trials of an entry were assessed, as JSON, None without one."""
    task = entry.config.config.get("task")
    return json.dumps(task, sort_keys=True) if task and entry.final_losses() else None


def measure_control(reader: Reader, selection: Selection) -> tuple[ControlCurve, ...]:
    """Return a curve for each entry."""
    with reader.moment() as moment:
        truths = {env: true_model(moment, selection.of(env)) for env in selection.environments}
        return tuple(_curve(moment, entry, truths[entry.config.env]) for entry in selection.entries)


def _measured(reader: Reader, entry: Entry, *measures: str) -> list[Assessments]:
    """Return measures of the trials that the entry holds as finished, all of one moment."""
    seeds = [trial.seed for trial in entry.finished]
    with reader.moment() as moment:
        found = [moment.assessments(entry.config.config_key, measure) for measure in measures]
    kept = [np.isin(one.seeds, seeds) for one in found]
    return [
        Assessments(one.seeds[rows], one.t, one.values[rows], one.diverged[rows])
        for one, rows in zip(found, kept, strict=True)
    ]


def true_model(reader: Reader, entries: Iterable[Entry]) -> TrueModel:
    """Return what the true model achieved on the seeds of some entries, each seed once.

    Trials of one seed, environment and task share that episode.
    """
    successes: dict[int, float] = {}
    costs: dict[int, float] = {}
    with reader.moment() as moment:
        for entry in entries:
            own = _measured(moment, entry, "true_model_success", "true_model_cost")
            for total, measured in zip((successes, costs), own, strict=True):
                total.update(_first(measured))
    found = np.array(list(successes.values()))
    known = [seed for seed, success in successes.items() if np.isfinite(success)]
    finite = _usable(np.array([costs.get(seed, np.nan) for seed in known]))
    return TrueModel(len(known), *_rate(found), int(np.sum(~finite)))


def _first(found: Assessments) -> dict[int, float]:
    """Return the number of each seed after the first number of steps."""
    return dict(zip(found.seeds.tolist(), found.values[:, :1].ravel().tolist(), strict=True))


def _curve(reader: Reader, entry: Entry, truth: TrueModel) -> ControlCurve:
    with reader.moment() as moment:
        (successes,) = _measured(moment, entry, "control_success")
        ratios = relative_costs(moment, entry).values
    reached = np.isfinite(successes.values)
    success, success_low, success_high = _by_step(_rate, successes.values)
    cost, cost_low, cost_high = _by_step(geometric_mean, ratios)
    return ControlCurve(
        entry.config.env,
        entry.config.policy,
        successes.t,
        np.sum(reached, axis=0),
        success,
        success_low,
        success_high,
        cost,
        cost_low,
        cost_high,
        np.sum(reached & ~_usable(ratios), axis=0),
        truth,
        but_diverged(len(successes.seeds), int(np.sum(successes.diverged))),
    )


def _by_step(estimate: Estimate, values: Array) -> Array:
    """Return centre, low and high, (3, k), of values (n, k) at each step."""
    return np.array([estimate(column) for column in values.T]).reshape(-1, 3).T


def relative_costs(reader: Reader, entry: Entry) -> Assessments:
    """Return the cost of each trial and number of steps, relative to its true model's.

    It is inf where the episode has no finite cost, and NaN where there was no episode or where the
    true model's has no finite cost, so that nothing can be said.
    """
    measures = "control_cost", "control_success", "true_model_cost"
    costs, successes, truths = _measured(reader, entry, *measures)
    reached, of_seed = np.isfinite(successes.values), _first(truths)
    divisors = np.array([of_seed.get(seed, np.nan) for seed in costs.seeds.tolist()])
    divisors = np.where(_usable(divisors), divisors, np.nan)
    values = np.where(reached & ~np.isfinite(costs.values), np.inf, costs.values)
    return Assessments(costs.seeds, costs.t, values / divisors[:, None], costs.diverged)


def _rate(successes: Array) -> Interval:
    """Return the share of successes among (n,), NaN left out, with its Wilson interval."""
    known = successes[np.isfinite(successes)]
    if not len(known):
        return np.nan, np.nan, np.nan
    from scipy import stats  # its import takes longer than most commands

    test = stats.binomtest(int(np.sum(known)), len(known))
    interval = test.proportion_ci(confidence_level=CONFIDENCE, method="wilson")
    return float(np.mean(known)), float(interval.low), float(interval.high)


def _usable(values: Array) -> npt.NDArray[np.bool_]:
    """Return which costs or ratios have a logarithm."""
    return np.isfinite(values) & (values > 0)


def geometric_mean(ratios: Array) -> Interval:
    """Return the geometric mean of the finite ones of (n,), with Student's interval."""
    known = np.log(ratios[_usable(ratios)])
    found = band(known[:, None])
    centre, low, high = (float(np.exp(end[0])) for end in (found.centre, found.low, found.high))
    return centre, low, high


def scores_at(reader: Reader, entry: Entry, t: int) -> Scores:
    """Return the relative cost of each trial that reached t explored steps.

    As in :func:`relative_costs` a lost episode has inf, and NaN where the true model's was lost.
    """
    with reader.moment() as moment:
        costs = relative_costs(moment, entry)
        (successes,) = _measured(moment, entry, "control_success")
    reached = np.isfinite(successes.values)
    at = costs.t == t
    seeds = costs.seeds[reached[:, at].any(axis=1)]
    column = costs.values[reached & at]
    by_seed = dict(zip(seeds.tolist(), column.tolist(), strict=True))
    names = entry.config.env, entry.config.policy, entry.label
    return Scores(*names, by_seed, len(costs.seeds), int(np.sum(costs.diverged)))


def tabulate_control(curves: Iterable[ControlCurve]) -> pd.DataFrame:
    """Return what is drawn, one row for each environment, policy and number of steps."""
    columns = (
        *("t", "n", "success", "success_low", "success_high"),
        *("cost", "cost_low", "cost_high", "lost"),
    )
    return pd.concat(
        [
            pd.DataFrame(
                {"env": curve.env, "policy": curve.policy}
                | {name: getattr(curve, name) for name in columns}
                | {"true_model_success": curve.truth.success}
            )
            for curve in curves
        ],
        ignore_index=True,
    )
