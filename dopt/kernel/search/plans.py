"""Search for the best plan in compiled code (:mod:`dopt.policies.search`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.algorithm import TIE_MARGIN, Score
from dopt.kernel.compiler import compiled, monotonic_microseconds
from dopt.kernel.search.path import (
    Path,
    apply_inverse,
    log_determinant,
    model_and_jacobian,
    new_path,
    rollout,
    rows_of_state,
)
from dopt.kernel.search.scores import ScoreContext, score_context, score_of_path
from dopt.kernel.state_structs import Covariance
from dopt.kernel.structs import Network, Plant, Search, Trial
from dopt.types import Booleans, Integers, Matrix, Vector


class Problem(NamedTuple):
    """All that the plans of one step share."""

    plant: Plant
    network: Network
    search: Search
    theta: Vector
    covariance: Covariance
    path: Path
    context: ScoreContext
    end: float  # when the time is spent [µs]


@compiled
def plan(trial: Trial, t: int, u: Vector) -> None:
    """Write the first input of the best plan that was found in time, (m,)."""
    plant, network, search = trial.plant, trial.network, trial.algorithm.search
    theta, covariance = trial.state.theta, trial.state.covariance
    x, tie = trial.record.states[t], trial.randomness.ties[t]
    end = monotonic_microseconds() + search.budget_us
    path = new_path(plant, network, search, covariance, x.shape[0])
    context = score_context(plant, network, search, theta, covariance, path)
    for i in range(x.shape[0]):
        path.states[0, i] = x[i]
    model_and_jacobian(plant, network, theta, path, 0, path.rows[path.products.shape[0] :])
    problem = Problem(plant, network, search, theta, covariance, path, context, end)
    order = _order(search.candidates, tie)
    _choose(_values(problem, order), search.candidates, tie, u)


@compiled
def _order(candidates: Matrix, tie: Vector) -> Integers:
    """Return the candidates, (C,), in the order in which they are tried: opposite ones in turn.

    The first is that nearest to a random direction, so that haste prefers no input to another.
    """
    C = candidates.shape[0]
    ranks = np.argsort(-np.dot(candidates, tie), kind="mergesort")
    order = np.empty_like(ranks)
    order[::2], order[1::2] = ranks[: C - C // 2], ranks[::-1][: C // 2]
    return order


@compiled
def _values(problem: Problem, order: Integers) -> Matrix:
    """Return the scores of the plans by their two candidates, (C, C); -∞ where there is none.

    In a hurry the plans without a switch come first, then the switches from the best of these.
    """
    search = problem.search
    unhurried, switching = search.budget_us == 0.0, search.switch < search.steps
    C = search.candidates.shape[0]
    values = np.full((C, C), -np.inf)
    for k in range(C):
        if k > 0 and _late(problem):
            break
        c = order[k]
        begun = _begin(problem, c)
        values[c, c] = _finish(problem, c, begun)
        if unhurried and switching:
            _switches(problem, order, c, begun, values[c])
    if switching and not unhurried:
        begun_from = np.zeros(C, np.bool_)
        for _ in range(C):
            if _late(problem):
                break
            c = _best_hold(values, begun_from)
            begun_from[c] = True
            begun = _begin(problem, c)
            _switches(problem, order, c, begun, values[c])
    return values


@compiled
def _best_hold(values: Matrix, done: Booleans) -> int:
    """Return the candidate with the best plan without a switch among those that are not done."""
    best = -1
    for c in range(values.shape[0]):
        if not done[c] and (best < 0 or values[c, c] > values[best, best]):
            best = c
    return best


@compiled
def _late(problem: Problem) -> bool:
    """Tell whether the time of this step is spent."""
    late: bool = problem.search.budget_us > 0.0 and monotonic_microseconds() >= problem.end
    return late


@compiled
def _switches(problem: Problem, order: Integers, c: int, begun: float, values: Vector) -> None:
    """Score the plans that begin with candidate c, as the path does, and switch to another."""
    for other in order:
        if other != c:
            if _late(problem):
                break
            values[other] = _finish(problem, other, begun)


@compiled
def _begin(problem: Problem, c: int) -> float:
    """Roll the path under candidate c up to the switch; return log det of its rows so far."""
    switch = problem.search.switch
    if not _roll(problem, c, 0, switch):
        return -np.inf
    return _gain(problem, 0, switch)


@compiled
def _finish(problem: Problem, c: int, begun: float) -> float:
    """Roll the path under candidate c from the switch to its end; return the plan's score.

    It is -∞ where the path leaves the bounds of a state, or the score is not finite.
    """
    search = problem.search
    if begun == -np.inf:
        return begun
    if not _roll(problem, c, search.switch, search.steps):
        return -np.inf
    value = begun + _gain(problem, search.switch, search.steps)
    if search.score not in (Score.JOINT, Score.SUM):
        value = score_of_path(search.score, problem.path, problem.context)
    return value if np.isfinite(value) else -np.inf


@compiled
def _roll(problem: Problem, c: int, first: int, last: int) -> bool:
    """Hold candidate c from state ``first`` to state ``last`` of the path."""
    path, search = problem.path, problem.search
    u = search.candidates[c]
    plant, network, theta = problem.plant, problem.network, problem.theta
    inside: bool = rollout(plant, network, search, theta, path, u, first, last)
    return inside


@compiled
def _gain(problem: Problem, first: int, last: int) -> float:
    """Return the growth of log det by the rows of steps ``first`` to ``last``."""
    path, search = problem.path, problem.search
    R = rows_of_state(problem.plant, problem.network)
    first, last = R * (first // search.stride), R * (last // search.stride)
    apply_inverse(problem.covariance, path, first, last)
    block = R if search.score == Score.SUM else path.products.shape[0]
    gain: float = log_determinant(path, first, last, block)
    return gain


@compiled
def _choose(values: Matrix, candidates: Matrix, tie: Vector, u: Vector) -> None:
    """Write the candidate that begins the best plan; ``tie`` decides among equal ones."""
    best, preferred = np.max(values), -np.inf
    for c in range(values.shape[0]):
        along = np.dot(candidates[c], tie)
        if np.max(values[c]) >= best - TIE_MARGIN * abs(best) and along > preferred:
            preferred = along
            u[:] = candidates[c]
