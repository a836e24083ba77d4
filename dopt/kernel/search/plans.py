"""Search for the best plan in compiled code (:mod:`dopt.policies.search`).

A plan is a pair of candidates: the first is held up to the switch, the second from there on. Where
there is no switch only plans of the same candidate twice count. Legend beside
:mod:`dopt.kernel.search.path`; P paths advance together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.algorithm import TIE_MARGIN, Score
from dopt.kernel.compiler import compiled, monotonic_microseconds
from dopt.kernel.model import n_next_points
from dopt.kernel.network import multiply_vector
from dopt.kernel.search.path import (
    Path,
    Place,
    ScoreContext,
    add_rows,
    advance_paths,
    keep_points,
    log_determinant,
    new_path,
    paths_from,
    rows_of_state,
    score_context,
    score_of_path,
    switch_of,
)
from dopt.kernel.structs import Network, Plant, Search, State, Trial
from dopt.kernel.vectors import inner
from dopt.types import Booleans, Integers, Matrix, Vector


class Problem(NamedTuple):
    """Model, covariance and state that all plans of a step share."""

    plant: Plant
    network: Network
    search: Search
    state: State
    x: Vector  # (d,), the present state
    path: Path
    context: ScoreContext
    end: float  # when the time is spent [µs]


class Halves(NamedTuple):
    """Paths from one state to another, each under one candidate."""

    ends: Matrix  # (P, d)
    inside: Booleans  # (P,), whether all states are within bounds
    points: Matrix  # points of the states whose rows count, path by path


@compiled
def plan(trial: Trial, t: int, u: Vector) -> None:
    """Write the first input of the best plan that was found in time, (m,)."""
    plant, network, search = trial.plant, trial.network, trial.algorithm.search
    state = trial.state
    x, tie = trial.record.states[t], trial.randomness.ties[t]
    end = monotonic_microseconds() + search.budget_us
    path = new_path(plant, network, search, state)
    context = score_context(plant, network, search, state.theta, state.covariance)
    problem = Problem(plant, network, search, state, x, path, context, end)
    hurried = search.budget_us > 0.0
    values = (
        _values_in_time(problem, _order(search.candidates, tie))
        if hurried
        else _all_values(problem)
    )
    _choose(values, search.candidates, tie, u)


@compiled
def _order(candidates: Matrix, tie: Vector) -> Integers:
    """Return the candidates, (C,), in the order in which they are tried: opposite ones in turn.

    The first is that nearest to a random direction, so that haste prefers no input to another.
    """
    C = candidates.shape[0]
    along = np.empty(C)
    multiply_vector(candidates, -tie, along)
    ranks = np.argsort(along, kind="mergesort")
    order = np.empty_like(ranks)
    order[::2], order[1::2] = ranks[: C - C // 2], ranks[::-1][: C // 2]
    return order


@compiled
def _all_values(problem: Problem) -> Matrix:
    """Return the scores of plans by their two candidates, (C, C); -∞ for pairs without a plan."""
    C, switch = problem.search.candidates.shape[0], switch_of(problem.search)
    values, candidates = np.full((C, C), -np.inf), np.arange(C)
    first = candidates if switch > 0 else candidates[:1]
    n = first.shape[0]
    begun = _begin(problem, first)
    ended = _end(problem, begun, np.repeat(np.arange(n), C), np.arange(n * C) % C)
    for k in range(n):
        gain = _share(problem, begun, k)
        scores = _scores(problem, gain, ended, k * C, C)
        for c in range(C):
            values[first[k] if switch > 0 else c, c] = scores[c]
    return values


@compiled
def _values_in_time(problem: Problem, order: Integers) -> Matrix:
    """Return the scores of the plans, (C, C), for which there is time; -∞ for the others.

    The plans without a switch come first, then the switches from the best of these.
    """
    C = problem.search.candidates.shape[0]
    values = np.full((C, C), -np.inf)
    for k in range(C):
        if k > 0 and _late(problem):
            return values
        _score_one_by_one(problem, order[k], order[k : k + 1], values)
    done = np.zeros(C, np.bool_)
    for _ in range(C if switch_of(problem.search) > 0 else 0):
        if _late(problem):
            return values
        c = _best_hold(values, done)
        done[c] = True
        _score_one_by_one(problem, c, order[order != c], values)
    return values


@compiled
def _score_one_by_one(problem: Problem, c: int, others: Integers, values: Matrix) -> None:
    """Score the plans from candidate c to others until the time is spent, the first in any case."""
    begun, start = _begin(problem, np.full(1, c)), np.zeros(1, np.int64)
    gain = _share(problem, begun, 0)
    for k in range(others.shape[0]):
        if k > 0 and _late(problem):
            return
        ended = _end(problem, begun, start, others[k : k + 1])
        values[c, others[k]] = _scores(problem, gain, ended, 0, 1)[0]


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
    """Return True if the time of this step is spent."""
    late: bool = problem.search.budget_us > 0.0 and monotonic_microseconds() >= problem.end
    return late


@compiled
def _begin(problem: Problem, chosen: Integers) -> Halves:
    """Hold candidates from the present state up to the switch."""
    x, search = problem.x, problem.search
    starts = np.empty((chosen.shape[0], x.shape[0]))
    starts[:] = x
    return _roll(problem, starts, search.candidates[chosen], 0, switch_of(search))


@compiled
def _end(problem: Problem, begun: Halves, paths: Integers, chosen: Integers) -> Halves:
    """Hold candidates from the ends of paths up to the switch to the end of the plan."""
    search = problem.search
    inputs, switch = search.candidates[chosen], switch_of(search)
    ended = _roll(problem, begun.ends[paths], inputs, switch, search.steps)
    return Halves(ended.ends, ended.inside & begun.inside[paths], ended.points)


@compiled
def _roll(problem: Problem, starts: Matrix, inputs: Matrix, first: int, last: int) -> Halves:
    """Hold inputs, (P, m), from states, (P, d), at step ``first`` to step ``last``."""
    plant, network, stride = problem.plant, problem.network, problem.search.stride
    (P, d), (_, m) = starts.shape, inputs.shape
    n = last // stride - first // stride
    kept = np.empty((P * n * n_next_points(network), d + network.n_inputs_read))
    paths, held = paths_from(plant, network, starts), inputs.reshape(P, 1, m)
    for i in range(first, last):
        advance_paths(plant, network, problem.state.theta, paths, held, 0)
        if (i + 1) % stride == 0:
            place = (i + 1) // stride - first // stride - 1
            keep_points(plant, network, paths, place, n, kept)
    return Halves(paths.states, paths.inside, kept)


@compiled
def _share(problem: Problem, begun: Halves, k: int) -> float:
    """Make the rows of path k up to the switch those that plans share; return their log det."""
    _write_rows(problem, begun, k, 1, 0)
    shared = _shared_rows(problem)
    gain: float = log_determinant(problem.path, Place(shared, 0), 0, shared, _block(problem))
    return gain


@compiled
def _scores(problem: Problem, begun: float, ended: Halves, first: int, count: int) -> Vector:
    """Return the scores of the plans that end with so many paths, given log det up to the switch.

    They are -∞ where the path leaves the bounds of a state, or the score is not finite.
    """
    search, path = problem.search, problem.path
    shared, n = _shared_rows(problem), path.factor.shape[0]
    _write_rows(problem, ended, first, count, shared)
    scores = np.full(count, -np.inf)
    for k in range(count):
        if not ended.inside[first + k]:
            continue
        place = Place(shared, k * (n - shared))
        value = begun + log_determinant(path, place, shared, n, _block(problem))
        if search.score not in (Score.JOINT, Score.SUM):
            value = score_of_path(search.score, path, place, problem.context)
        scores[k] = value if np.isfinite(value) else -np.inf
    return scores


@compiled
def _write_rows(problem: Problem, halves: Halves, first: int, count: int, row: int) -> None:
    """Write the rows of so many paths and their products, from a row on."""
    n = halves.points.shape[0] // halves.ends.shape[0]
    points = halves.points[first * n : (first + count) * n]
    plant, network, search = problem.plant, problem.network, problem.search
    add_rows(plant, network, search, problem.state, points, problem.path, row)


@compiled
def _shared_rows(problem: Problem) -> int:
    """Return how many rows of a path come before the switch."""
    search = problem.search
    count: int = rows_of_state(problem.plant, problem.network) * (
        switch_of(search) // search.stride
    )
    return count


@compiled
def _block(problem: Problem) -> int:
    """Return how many rows are taken together: the rows of a state, or of the whole path."""
    if problem.search.score == Score.SUM:
        return rows_of_state(problem.plant, problem.network)
    n: int = problem.path.factor.shape[0]
    return n


@compiled
def _choose(values: Matrix, candidates: Matrix, tie: Vector, u: Vector) -> None:
    """Write the candidate that begins the best plan; ``tie`` decides among equal ones."""
    best, preferred = np.max(values), -np.inf
    for c in range(values.shape[0]):
        along = inner(candidates[c], tie)
        if np.max(values[c]) >= best - TIE_MARGIN * abs(best) and along > preferred:
            preferred = along
            u[:] = candidates[c]
