"""Search for the best plan in compiled code (:mod:`dopt.policies.search`)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dopt.kernel.arguments import (
    A_OPTIMAL,
    E_OPTIMAL,
    JOINT,
    SUM,
    TASK,
    TRACE,
    Floats,
    Network,
    Rules,
    State,
    World,
)
from dopt.kernel.compiler import compiled, monotonic_microseconds, vectorized
from dopt.kernel.information import inner
from dopt.kernel.krylov import krylov_space, largest_eigenvalue
from dopt.kernel.path import Path, log_determinant, look, new_path, roll, weigh, whiten
from dopt.policies.search import TIE_MARGIN


class Yardstick(NamedTuple):
    """What a score needs beside the path; empty where it needs nothing."""

    probes: Floats  # (n, q), J at the task's states or the basis of the Krylov space
    projected: Floats  # (K, K), M⁻¹ in the Krylov space


class Problem(NamedTuple):
    """Everything that the plans of one step share."""

    world: World
    network: Network
    rules: Rules
    state: State
    path: Path
    yardstick: Yardstick
    end: float  # when the time is spent [µs]


@compiled
def search_input(
    known: Any,
    accelerations: Any,
    world: World,
    network: Network,
    rules: Rules,
    state: State,
    x: Any,
    tie: Any,
    u: Any,
) -> None:
    """Write the first input of the best plan that was found in time, (m,)."""
    end = monotonic_microseconds() + rules.search.budget_us
    path = new_path(world, network, rules, state.covariance, x.shape[0])
    yardstick = _yardstick(accelerations, world, network, rules, state, path)
    for i in range(x.shape[0]):
        path.states[0, i] = x[i]
    look(accelerations, world, network, state.theta, path, 0, path.rows[path.products.shape[0] :])
    problem = Problem(world, network, rules, state, path, yardstick, end)
    _choose(_values(known, accelerations, problem), rules.search.candidates, tie, u)


@compiled
def _values(known: Any, accelerations: Any, problem: Problem) -> Any:
    """Return the scores of the plans by their two candidates, (C, C); -∞ where there is none.

    In a hurry the plans without a switch come first, then the switches from the best of these.
    """
    search = problem.rules.search
    unhurried, switching = search.budget_us == 0.0, search.switch < search.steps
    C = search.candidates.shape[0]
    values = np.full((C, C), -np.inf)
    for c in range(C):
        if c > 0 and _late(problem):
            break
        begun = _begin(known, accelerations, problem, c)
        values[c, c] = _finish(known, accelerations, problem, c, begun)
        if unhurried and switching:
            _switches(known, accelerations, problem, c, begun, values[c])
    if switching and not unhurried:
        for c in np.argsort(-np.diag(values)):
            if _late(problem):
                break
            begun = _begin(known, accelerations, problem, c)
            _switches(known, accelerations, problem, c, begun, values[c])
    return values


@compiled
def _late(problem: Problem) -> bool:
    """Tell whether the time of this step is spent."""
    late: bool = problem.rules.search.budget_us > 0.0 and monotonic_microseconds() >= problem.end
    return late


@compiled
def _switches(
    known: Any, accelerations: Any, problem: Problem, c: int, begun: float, values: Any
) -> None:
    """Score the plans that begin with candidate c, as the path does, and switch to another."""
    for other in range(values.shape[0]):
        if other != c:
            if _late(problem):
                break
            values[other] = _finish(known, accelerations, problem, other, begun)


@compiled
def _begin(known: Any, accelerations: Any, problem: Problem, c: int) -> float:
    """Roll the path under candidate c up to the switch; return log det of its rows so far."""
    switch = problem.rules.search.switch
    if not _roll(known, accelerations, problem, c, 0, switch):
        return -np.inf
    return _gain(problem, 0, switch)


@compiled
def _finish(known: Any, accelerations: Any, problem: Problem, c: int, begun: float) -> float:
    """Roll the path under candidate c from the switch to its end; return the plan's score.

    It is -∞ where the path leaves the bounds of a state, or the score is not finite.
    """
    search = problem.rules.search
    if begun == -np.inf:
        return begun
    if not _roll(known, accelerations, problem, c, search.switch, search.steps):
        return -np.inf
    value = begun + _gain(problem, search.switch, search.steps)
    if search.score not in (JOINT, SUM):
        value = _other_score(search.score, problem.path, problem.yardstick)
    return value if np.isfinite(value) else -np.inf


@compiled
def _roll(known: Any, accelerations: Any, problem: Problem, c: int, first: int, last: int) -> bool:
    """Hold candidate c from state ``first`` to state ``last`` of the path."""
    world, network, rules = problem.world, problem.network, problem.rules
    theta, u = problem.state.theta, rules.search.candidates[c]
    inside: bool = roll(
        known, accelerations, world, network, rules, theta, problem.path, u, first, last
    )
    return inside


@compiled
def _gain(problem: Problem, first: int, last: int) -> float:
    """Return the growth of log det by the rows of steps ``first`` to ``last``."""
    path, search = problem.path, problem.rules.search
    r = problem.world.learned_rows.shape[0]
    first, last = r * (first // search.stride), r * (last // search.stride)
    weigh(problem.state.covariance, path, first, last)
    block = r if search.score == SUM else path.products.shape[0]
    gain: float = log_determinant(path, first, last, block)
    return gain


@vectorized
def _other_score(score: int, path: Path, yardstick: Yardstick) -> float:
    """Return the score of a whole path whose factor is known, if it is not a determinant."""
    n, total = path.products.shape[0], 0.0
    if score == TRACE:
        for i in range(n):
            total += inner(path.products[i], path.rows[i])
        return total
    whiten(path, n)
    if score == E_OPTIMAL:
        return -largest_eigenvalue(yardstick.projected, yardstick.probes, path.products)
    for i in range(n):
        if score == A_OPTIMAL:
            total += inner(path.products[i], path.products[i])
        for j in range(yardstick.probes.shape[0]):
            total += inner(path.products[i], yardstick.probes[j]) ** 2
    return total


@compiled
def _yardstick(
    accelerations: Any, world: World, network: Network, rules: Rules, state: State, path: Path
) -> Yardstick:
    """Return what the score needs at these parameters and this M⁻¹."""
    search, q, r = rules.search, state.theta.shape[0], world.learned_rows.shape[0]
    if search.score == E_OPTIMAL:
        basis, projected = krylov_space(state.covariance, search.starts, search.subspace)
        return Yardstick(basis, projected)
    n = search.task_states.shape[0] if search.score == TASK else 0
    rows = np.empty((n * r, q))
    for s in range(n):
        for i in range(path.flow.shape[0]):
            path.states[0, i] = search.task_states[s, i]
        look(accelerations, world, network, state.theta, path, 0, rows[s * r : (s + 1) * r])
    return Yardstick(rows, np.empty((0, 0)))


@compiled
def _choose(values: Any, candidates: Any, tie: Any, u: Any) -> None:
    """Write the candidate that begins the best plan; ``tie`` decides among equal ones."""
    best = np.max(values)
    u[:] = np.nan
    if best == -np.inf:
        return
    preferred = -np.inf
    for c in range(values.shape[0]):
        along = np.dot(candidates[c], tie)
        if np.max(values[c]) >= best - TIE_MARGIN * abs(best) and along > preferred:
            preferred = along
            u[:] = candidates[c]
