"""Figure 5 as numbers: control with the learned model against explored steps.

Each trial that was assessed gives two numbers after some of its steps: whether the episode that its
model planned succeeded, and what it cost beside the true model under the same planner, noise and
draws.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from analysis.choice import Candidate, choose
from analysis.measures import Scores
from analysis.selection import Entry, Selection, environment_rank, policy_rank
from analysis.statistics import LEVEL, band
from orchestrate.store import Assessments, Reader

Array = npt.NDArray[np.float64]

Interval = tuple[float, float, float]
"""Centre, low and high."""

Estimate = Callable[[Array], Interval]


@dataclass(frozen=True)
class ControlCurve:
    """What the trials of one policy were worth in one environment, after k numbers of steps.

    Attributes
    ----------
    t, n : (k,)
        Explored steps, and trials that reached them.
    success, success_low, success_high : (k,)
        Share of successful episodes, with its Wilson interval of 95 %.
    cost, cost_low, cost_high : (k,)
        Geometric mean of the cost by the true model's, with Student's interval of 95 %.
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
    described: str


def control_part(selection: Selection) -> Selection:
    """Return the entries with a task, in each environment those of the task with most trials."""
    asked = [entry for entry in selection.stored if entry.cell.config.get("task")]
    asked = [entry for entry in asked if entry.final_losses()]
    chosen: list[Entry] = []
    for env in dict.fromkeys(entry.cell.env for entry in asked):
        chosen += _of_one_task([entry for entry in asked if entry.cell.env == env])
    chosen.sort(key=lambda e: (environment_rank(e.cell.env), policy_rank(e.cell.policy)))
    return Selection(tuple(chosen), notes=tuple(_unfinished(chosen)), stored=tuple(chosen))


def _of_one_task(entries: list[Entry]) -> list[Entry]:
    totals: Counter[str] = Counter()
    for entry in entries:
        totals[_task(entry)] += len(entry.trials)
    most = max(totals, key=lambda task: (totals[task], task))
    same = {entry.cell.config_key: entry for entry in entries if _task(entry) == most}
    cells = choose(Candidate(entry.cell, len(entry.trials)) for entry in same.values())
    return [same[cell.config_key] for cell in cells]


def _task(entry: Entry) -> str:
    return json.dumps(entry.cell.config["task"], sort_keys=True)


def _unfinished(entries: Iterable[Entry]) -> Iterable[str]:
    for entry in entries:
        left = len(entry.trials) - len(entry.finished)
        if left:
            yield f"{entry.cell.env} × {entry.cell.policy}: {left} trials with a task not finished"


def measure_control(reader: Reader, selection: Selection) -> tuple[ControlCurve, ...]:
    """Return a curve for each entry."""
    return tuple(_curve(reader, entry) for entry in selection.entries)


def _curve(reader: Reader, entry: Entry) -> ControlCurve:
    successes = reader.assessments(entry.cell.config_key, "control_success")
    ratios = relative_costs(reader, entry).values
    success, success_low, success_high = _by_step(_rate, successes.values)
    cost, cost_low, cost_high = _by_step(_mean_ratio, ratios)
    diverged = int(np.sum(successes.diverged))
    return ControlCurve(
        entry.cell.env,
        entry.cell.policy,
        successes.t,
        np.sum(np.isfinite(successes.values), axis=0),
        success,
        success_low,
        success_high,
        cost,
        cost_low,
        cost_high,
        f"{len(successes.seeds)}, {diverged} diverged" if diverged else f"{len(successes.seeds)}",
    )


def _by_step(estimate: Estimate, values: Array) -> Array:
    """Return centre, low and high, (3, k), of values (n, k) at each step."""
    return np.array([estimate(column) for column in values.T]).reshape(-1, 3).T


def relative_costs(reader: Reader, entry: Entry) -> Assessments:
    """Return the cost of each trial and number of steps by that of its true model."""
    key = entry.cell.config_key
    costs = reader.assessments(key, "control_cost")
    truth = reader.assessments(key, "true_model_cost")
    of_seed = dict(zip(truth.seeds.tolist(), truth.values[:, :1].ravel().tolist(), strict=True))
    divisors = np.array([of_seed.get(seed, np.nan) for seed in costs.seeds.tolist()])
    return Assessments(costs.seeds, costs.t, costs.values / divisors[:, None], costs.diverged)


def _rate(successes: Array) -> Interval:
    """Return the share of successes among (n,), NaN left out, with its Wilson interval."""
    known = successes[np.isfinite(successes)]
    if not len(known):
        return np.nan, np.nan, np.nan
    test = stats.binomtest(int(np.sum(known)), len(known))
    interval = test.proportion_ci(confidence_level=LEVEL, method="wilson")
    return float(np.mean(known)), float(interval.low), float(interval.high)


def _mean_ratio(ratios: Array) -> Interval:
    """Return the geometric mean of (n,), NaN left out, with Student's interval."""
    known = np.log(ratios[np.isfinite(ratios) & (ratios > 0)])
    found = band(known[:, None])
    centre, low, high = (float(np.exp(end[0])) for end in (found.centre, found.low, found.high))
    return centre, low, high


def scores_at(reader: Reader, entry: Entry, t: int) -> Scores:
    """Return the relative cost of each trial after t explored steps."""
    costs = relative_costs(reader, entry)
    column = costs.values[:, np.flatnonzero(costs.t == t)].ravel()
    by_seed = {
        seed: value
        for seed, value in zip(costs.seeds.tolist(), column.tolist(), strict=False)
        if np.isfinite(value)
    }
    return Scores(
        entry.cell.env, entry.cell.policy, by_seed, len(costs.seeds), int(np.sum(costs.diverged))
    )


def tabulate_control(curves: Iterable[ControlCurve]) -> pd.DataFrame:
    """Return what is drawn, one row for each environment, policy and number of steps."""
    columns = ("t", "n", "success", "success_low", "success_high", "cost", "cost_low", "cost_high")
    return pd.concat(
        [
            pd.DataFrame(
                {"env": curve.env, "policy": curve.policy}
                | {name: getattr(curve, name) for name in columns}
            )
            for curve in curves
        ],
        ignore_index=True,
    )
