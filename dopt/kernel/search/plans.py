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
    Covariance,
    Floats,
    Network,
    Search,
    World,
)
from dopt.kernel.compiler import compiled, monotonic_microseconds, vectorized
from dopt.kernel.information import inner
from dopt.kernel.krylov import krylov_space, largest_eigenvalue
from dopt.kernel.path import Path, log_determinant, look, new_path, roll, weigh, whiten
from dopt.planning.ties import TIE_MARGIN


class Yardstick(NamedTuple):
    """What a score needs beside the path; empty where it needs nothing."""

    probes: Floats  # (n, q), J at the task's states or the basis of the Krylov space
    projected: Floats  # (K, K), M⁻¹ in the Krylov space


class Problem(NamedTuple):
    """Everything that the plans of one step share."""

    world: World
    network: Network
    search: Search
    theta: Floats
    covariance: Covariance
    path: Path
    yardstick: Yardstick
    end: float  # when the time is spent [µs]


@compiled
def search_input(
    known: Any,
    accelerations: Any,
    world: World,
    network: Network,
    search: Search,
    theta: Any,
    covariance: Covariance,
    x: Any,
    tie: Any,
    u: Any,
) -> None:
    """Write the first input of the best plan that was found in time, (m,)."""
    end = monotonic_microseconds() + search.budget_us
    path = new_path(world, network, search, covariance, x.shape[0])
    yardstick = _yardstick(accelerations, world, network, search, theta, covariance, path)
    for i in range(x.shape[0]):
        path.states[0, i] = x[i]
    look(accelerations, world, network, theta, path, 0, path.rows[path.products.shape[0] :])
    problem = Problem(world, network, search, theta, covariance, path, yardstick, end)
    order = _order(search.candidates, tie)
    _choose(_values(known, accelerations, problem, order), search.candidates, tie, u)


@compiled
def no_search(
    known: Any,  # noqa: ARG001  # the signature is that of the search
    accelerations: Any,  # noqa: ARG001
    world: World,  # noqa: ARG001
    network: Network,  # noqa: ARG001
    search: Search,  # noqa: ARG001
    theta: Any,  # noqa: ARG001
    covariance: Covariance,  # noqa: ARG001
    x: Any,  # noqa: ARG001
    tie: Any,  # noqa: ARG001
    u: Any,
) -> None:
    """Stand where a policy needs no search, which takes long to compile."""
    u[:] = np.nan


@compiled
def _order(candidates: Any, tie: Any) -> Any:
    """Return the candidates, (C,), in the order in which they are tried: opposite ones in turn.

    The first is that nearest to a random direction, so that haste prefers no input to another.
    """
    C = candidates.shape[0]
    ranks = np.argsort(-np.dot(candidates, tie), kind="mergesort")
    order = np.empty_like(ranks)
    order[::2], order[1::2] = ranks[: C - C // 2], ranks[::-1][: C // 2]
    return order


@compiled
def _values(known: Any, accelerations: Any, problem: Problem, order: Any) -> Any:
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
        begun = _begin(known, accelerations, problem, c)
        values[c, c] = _finish(known, accelerations, problem, c, begun)
        if unhurried and switching:
            _switches(known, accelerations, problem, order, c, begun, values[c])
    if switching and not unhurried:
        begun_from = np.zeros(C, np.bool_)
        for _ in range(C):
            if _late(problem):
                break
            c = _best_hold(values, begun_from)
            begun_from[c] = True
            begun = _begin(known, accelerations, problem, c)
            _switches(known, accelerations, problem, order, c, begun, values[c])
    return values


@compiled
def _best_hold(values: Any, done: Any) -> int:
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
def _switches(
    known: Any, accelerations: Any, problem: Problem, order: Any, c: int, begun: float, values: Any
) -> None:
    """Score the plans that begin with candidate c, as the path does, and switch to another."""
    for other in order:
        if other != c:
            if _late(problem):
                break
            values[other] = _finish(known, accelerations, problem, other, begun)


@compiled
def _begin(known: Any, accelerations: Any, problem: Problem, c: int) -> float:
    """Roll the path under candidate c up to the switch; return log det of its rows so far."""
    switch = problem.search.switch
    if not _roll(known, accelerations, problem, c, 0, switch):
        return -np.inf
    return _gain(problem, 0, switch)


@compiled
def _finish(known: Any, accelerations: Any, problem: Problem, c: int, begun: float) -> float:
    """Roll the path under candidate c from the switch to its end; return the plan's score.

    It is -∞ where the path leaves the bounds of a state, or the score is not finite.
    """
    search = problem.search
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
    world, network, search, theta = problem.world, problem.network, problem.search, problem.theta
    path, u = problem.path, search.candidates[c]
    inside: bool = roll(known, accelerations, world, network, search, theta, path, u, first, last)
    return inside


@compiled
def _gain(problem: Problem, first: int, last: int) -> float:
    """Return the growth of log det by the rows of steps ``first`` to ``last``."""
    path, search = problem.path, problem.search
    r = problem.world.learned_rows.shape[0]
    first, last = r * (first // search.stride), r * (last // search.stride)
    weigh(problem.covariance, path, first, last)
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
    accelerations: Any,
    world: World,
    network: Network,
    search: Search,
    theta: Any,
    covariance: Covariance,
    path: Path,
) -> Yardstick:
    """Return what the score needs at these parameters and this M⁻¹."""
    q, r = theta.shape[0], world.learned_rows.shape[0]
    if search.score == E_OPTIMAL:
        basis, projected = krylov_space(covariance, search.starts, search.subspace)
        return Yardstick(basis, projected)
    n = search.task_states.shape[0] if search.score == TASK else 0
    rows = np.empty((n * r, q))
    for s in range(n):
        for i in range(path.flow.shape[0]):
            path.states[0, i] = search.task_states[s, i]
        look(accelerations, world, network, theta, path, 0, rows[s * r : (s + 1) * r])
    return Yardstick(rows, np.empty((0, 0)))


@compiled
def _choose(values: Any, candidates: Any, tie: Any, u: Any) -> None:
    """Write the candidate that begins the best plan; ``tie`` decides among equal ones."""
    best, preferred = np.max(values), -np.inf
    for c in range(values.shape[0]):
        along = np.dot(candidates[c], tie)
        if np.max(values[c]) >= best - TIE_MARGIN * abs(best) and along > preferred:
            preferred = along
            u[:] = candidates[c]
