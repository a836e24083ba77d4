"""Search for the best plan in compiled code (:mod:`dopt.policies.search`).

A plan is a pair of candidates: the first is held up to the switch, the second from there on. Where
there is no switch only plans of the same candidate twice count.

Paths: states, rows of J, their products with M⁻¹, and scores. Sizes beside
:mod:`dopt.kernel.structs`: H steps of a plan, C candidates, R rows of a state, n rows along a path;
P paths that advance together, K inputs of a path, n states of a path that are kept. The model is
evaluated at all paths at once, which costs less than one after the other. The largest eigenvalue of
M⁻¹ is taken from a block Krylov space.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.algorithm import TIE_MARGIN, ModelKind, Score
from dopt.kernel import gaussian_process as gp
from dopt.kernel.compiler import compiled, monotonic_microseconds, squared
from dopt.kernel.integration import write_rate
from dopt.kernel.linear_algebra import multiply_rows, write_dense
from dopt.kernel.model import accelerations_at, n_next_points, next_points, rows_at, within
from dopt.kernel.network import multiply_vector
from dopt.kernel.structs import Covariance, Network, Plant, Search, State, Trial
from dopt.kernel.vectors import add_multiple, inner, multiply, product
from dopt.types import Booleans, Integers, Matrix, Stack, Vector

INVARIANT = 1e-9
"""A Krylov direction shorter than this beside its origin is rounding: the space is invariant."""


@compiled
def krylov_space(covariance: Covariance, starts: Matrix, size: int) -> tuple[Matrix, Matrix]:
    """Return an orthonormal basis Q, (K, q), and Q M⁻¹ Qᵀ, (K, K).

    Row j ≥ b is M⁻¹ times row j - b, orthogonalised, with b the number of starts. Rows that add
    nothing are zero.
    """
    b, q = starts.shape
    K = min(size, q)
    basis, images = np.zeros((K, q)), np.zeros((K, q))
    for j in range(K):
        row = basis[j]
        for i in range(q):
            row[i] = starts[j, i] if j < b else images[j - b, i]
        _orthogonalize(basis, j)
        multiply_rows(covariance, basis[j : j + 1], images[j : j + 1])
    return basis, product(basis, images.T.copy())


@compiled
def _orthogonalize(basis: Matrix, j: int) -> None:
    """Make row j orthogonal to those before it and of norm 1 (Gram-Schmidt, twice)."""
    row = basis[j]
    before = np.sqrt(inner(row, row))
    for _ in range(2):
        for i in range(j):
            add_multiple(row, -inner(basis[i], row), basis[i])
    after = np.sqrt(inner(row, row))
    keep = after > INVARIANT * before
    for i in range(row.shape[0]):
        row[i] = row[i] / after if keep else 0.0


@compiled
def largest_eigenvalue(projected: Matrix, basis: Matrix, removed: Matrix) -> float:
    """Return the largest eigenvalue of M⁻¹ - WᵀW in the space, W = ``removed``, (r, q)."""
    W, K = product(removed, basis.T.copy()), projected.shape[0]
    left = projected.copy()
    for k in range(W.shape[0]):
        for i in range(K):
            add_multiple(left[i], -W[k, i], W[k])
    largest: float = np.linalg.eigvalsh(left)[K - 1]
    return largest


FEW_ROWS = 40
"""Largest number of products a step for which a full copy of M⁻¹ does not pay."""


class Path(NamedTuple):
    """Rows along paths that share what comes before the switch; written in place.

    A path has n states whose rows count, b of them before the switch, and there are C paths. Of a
    Gaussian process the rows are L⁻¹k, and the products the features of the states.
    """

    rows: Matrix  # (R (b + C (n - b)), q), J/√ρ before the switch, then after it path by path
    products: Matrix  # of the same size, J M⁻¹
    factor: Matrix  # (R n, R n), the Cholesky factor L of I + J M⁻¹ Jᵀ of one path
    inverse: Matrix  # (q, q), M⁻¹; empty where few products are needed
    kernels: Matrix  # numbers of Gaussian processes, (r, ·); empty in other models
    weight: float  # by which their covariances are multiplied beside 1/ν
    shared: int  # R b, rows of a path before the switch
    block: int  # rows that are taken together: R of a state, or all of a path


@compiled
def new_path(plant: Plant, network: Network, search: Search, state: State) -> Path:
    """Return an empty path."""
    covariance, q, p = state.covariance, state.covariance.size, state.covariance.size
    kernels = np.empty((0, 0))
    if network.kind == ModelKind.GAUSSIAN_PROCESS:
        q, p = network.process.n_samples[0], network.sizes[0]
        kernels = gp.numbers_by_row(network, state.theta, plant.learned_rows.shape[0])
    R, C = plant.learned_rows.shape[0] * n_next_points(network), search.candidates.shape[0]
    n, before = search.steps // search.stride, search.switch // search.stride
    count = R * (before + C * (n - before))
    size = covariance.size if (C if before > 0 else 1) * count > FEW_ROWS else 0
    inverse, factor = np.empty((size, size)), np.zeros((R * n, R * n))
    if size > 0:
        write_dense(covariance, inverse)
    weight = float(search.stride) if search.score == Score.JOINT else 1.0
    block = R if search.score == Score.SUM else R * n
    rows, products = np.empty((count, q)), np.empty((count, p))
    return Path(rows, products, factor, inverse, kernels, weight, R * before, block)


@compiled
def rows_of_points(plant: Plant, network: Network, theta: Vector, points: Matrix) -> Matrix:
    """Return the rows of J at the points of states, one state after the other.

    Where several points stand for a state (:mod:`dopt.kernel.model`) their rows are weighted so
    that the sum of their JᵀJ is the mean.
    """
    rows: Matrix = rows_at(plant, network, theta, points)
    per_state = n_next_points(network)
    if per_state > 1:
        rows /= np.sqrt(per_state)
    return rows


@compiled
def rows_at_states(plant: Plant, network: Network, theta: Vector, states: Matrix) -> Matrix:
    """Return the rows of J at the next points of states, (n, d), one state after the other."""
    n, per_state = states.shape[0], n_next_points(network)
    points = np.empty((n * per_state, states.shape[1] + network.n_inputs_read))
    for i in range(n):
        at = next_points(network, states[i], plant.gamma)
        points[i * per_state : (i + 1) * per_state] = at
    return rows_of_points(plant, network, theta, points)


@compiled
def row_at(path: Path, offset: int, i: int) -> int:
    """Return where the i-th row of a path is, whose rows after the switch are moved so far."""
    return i if i < path.shared else i + offset


@compiled
def log_determinant(path: Path, offset: int, first: int, last: int) -> float:
    """Extend the factor L by rows ``first`` to ``last`` of a path; return the growth of log det.

    Only rows of the same block are taken together: all of them for the determinant of the whole
    path, R for its states one by one.
    """
    L = path.factor
    total = 0.0
    for i in range(first, last):
        start = i - i % path.block
        for j in range(start, i + 1):
            value = _product_of_rows(path, offset, i, j)
            value -= inner(L[i, start:j], L[j, start:j])
            L[i, j] = np.sqrt(1.0 + value) if i == j else value / L[j, j]
        total += 2.0 * np.log(L[i, i])
    return total


@compiled
def _product_of_rows(path: Path, offset: int, i: int, j: int) -> float:
    """Return J M⁻¹ Jᵀ of the i-th and the j-th row of a path."""
    a, b = row_at(path, offset, i), row_at(path, offset, j)
    value: float
    if path.kernels.shape[0] == 0:
        value = inner(path.products[a], path.rows[b])
    else:
        value = path.weight * gp.information(path.kernels, path.products, path.rows, a, b)
    return value


@compiled
def whitened(path: Path, offset: int) -> Matrix:
    """Return L⁻¹ J M⁻¹, (R n, q), of a path whose factor is known."""
    n = path.factor.shape[0]
    out = np.empty((n, path.products.shape[1]))
    for i in range(n):
        row = out[i]
        row[:] = path.products[row_at(path, offset, i)]
        for j in range(i):
            add_multiple(row, -path.factor[i, j], out[j])
        for j in range(row.shape[0]):
            row[j] /= path.factor[i, i]
    return out


class Rolled(NamedTuple):
    """Paths from one state to another."""

    ends: Matrix  # (P, d)
    inside: Booleans  # (P,), whether all states are within bounds
    points: Matrix  # next points of the states whose rows count, path by path


@compiled
def roll(
    plant: Plant,
    network: Network,
    theta: Vector,
    starts: Matrix,
    inputs: Stack,
    places: Integers,
    first: int,
    stride: int,
) -> Rolled:
    """Take paths from states, (P, d), step by step to x + dt f_θ(x, u), all of them together.

    ``places``, one for each step, are the places of its input among the K of each path, (P, K, m).
    Rows count after every step whose number, from ``first`` on, is a multiple of the stride.
    """
    (P, d), r, per_state = starts.shape, plant.learned_rows.shape[0], n_next_points(network)
    m_read, last = network.n_inputs_read, first + places.shape[0]
    n = last // stride - first // stride
    states, inside, kept = (
        starts.copy(),
        np.ones(P, np.bool_),
        np.empty((P * n * per_state, d + m_read)),
    )
    points = states if m_read == 0 else np.empty((P, d + m_read))
    outputs, value, flow = np.empty((r, P)), np.empty(r), np.empty(d)
    for i in range(first, last):
        k = places[i - first]
        if m_read > 0:
            points[:, :d] = states
            points[:, d:] = inputs[:, k]
        accelerations_at(plant, network, theta, points, outputs)
        for p in range(P):
            for j in range(r):
                value[j] = outputs[j, p]
            write_rate(plant, states[p], inputs[p, k], value, flow)
            for j in range(d):
                states[p, j] += plant.dt * flow[j]
            inside[p] = inside[p] and within(states[p], plant.state_limit)
            if (i + 1) % stride == 0:
                place = per_state * (p * n + (i + 1) // stride - first // stride - 1)
                kept[place : place + per_state] = next_points(network, states[p], plant.gamma)
    return Rolled(states, inside, kept)


class ScoreContext(NamedTuple):
    """Arrays that a score needs beside the path; empty where it needs none."""

    probes: Matrix  # (n, q), J at the task's states or the basis of the Krylov space
    projected: Matrix  # (K, K), M⁻¹ in the Krylov space


@compiled
def score_of_path(score: int, path: Path, offset: int, context: ScoreContext) -> float:
    """Return the score of a whole path whose factor is known, if it is not a determinant."""
    n, total = path.factor.shape[0], 0.0
    if score == Score.TRACE:
        for i in range(n):
            total += _product_of_rows(path, offset, i, i)
        return total
    white = whitened(path, offset)
    if score == Score.E:
        return -largest_eigenvalue(context.projected, context.probes, white)
    for i in range(n):
        if score == Score.A:
            total += inner(white[i], white[i])
        for j in range(context.probes.shape[0]):
            total += squared(inner(white[i], context.probes[j]))
    return total


@compiled
def score_context(
    plant: Plant, network: Network, search: Search, theta: Vector, covariance: Covariance
) -> ScoreContext:
    """Return what the score needs at these parameters and this M⁻¹."""
    if search.score == Score.E:
        basis, projected = krylov_space(covariance, search.starts, search.subspace)
        return ScoreContext(basis, projected)
    states = search.task_states if search.score == Score.TASK else search.task_states[:0]
    return ScoreContext(rows_at_states(plant, network, theta, states), np.empty((0, 0)))


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
    if search.budget_us > 0.0:
        values = _values_in_time(problem, _order(search.candidates, tie))
    else:
        values = _all_values(problem)
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
    C, switch = problem.search.candidates.shape[0], problem.search.switch
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
    for _ in range(C if problem.search.switch > 0 else 0):
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
def _begin(problem: Problem, chosen: Integers) -> Rolled:
    """Hold candidates from the present state up to the switch."""
    starts = np.empty((chosen.shape[0], problem.x.shape[0]))
    starts[:] = problem.x
    return _held(problem, starts, chosen, 0, problem.search.switch)


@compiled
def _end(problem: Problem, begun: Rolled, paths: Integers, chosen: Integers) -> Rolled:
    """Hold candidates from the ends of paths up to the switch to the end of the plan."""
    search = problem.search
    ended = _held(problem, begun.ends[paths], chosen, search.switch, search.steps)
    return Rolled(ended.ends, ended.inside & begun.inside[paths], ended.points)


@compiled
def _held(problem: Problem, starts: Matrix, chosen: Integers, first: int, last: int) -> Rolled:
    """Hold candidates from states, (P, d), at step ``first`` to step ``last``."""
    plant, network, theta = problem.plant, problem.network, problem.state.theta
    inputs, places = problem.search.candidates[chosen], np.zeros(last - first, np.int64)
    held = inputs.reshape(inputs.shape[0], 1, inputs.shape[1])
    return roll(plant, network, theta, starts, held, places, first, problem.search.stride)


@compiled
def _share(problem: Problem, begun: Rolled, k: int) -> float:
    """Make the rows of path k up to the switch those that plans share; return their log det."""
    _write_rows(problem, begun, k, 1, 0)
    gain: float = log_determinant(problem.path, 0, 0, problem.path.shared)
    return gain


@compiled
def _scores(problem: Problem, begun: float, ended: Rolled, first: int, count: int) -> Vector:
    """Score ``count`` plans that share the path before the switch; ``begun`` is its log det.

    They are -∞ where the path leaves the bounds of a state, or the score is not finite.
    """
    score, path, n = problem.search.score, problem.path, problem.path.factor.shape[0]
    _write_rows(problem, ended, first, count, path.shared)
    scores = np.full(count, -np.inf)
    for k in range(count):
        if not ended.inside[first + k]:
            continue
        offset = k * (n - path.shared)
        value = begun + log_determinant(path, offset, path.shared, n)
        if score not in (Score.JOINT, Score.SUM):
            value = score_of_path(score, path, offset, problem.context)
        scores[k] = value if np.isfinite(value) else -np.inf
    return scores


@compiled
def _write_rows(problem: Problem, rolled: Rolled, first: int, count: int, row: int) -> None:
    """Write the rows of so many paths and their products with M⁻¹, from a row on.

    They are in the units of M, for the determinant of all of them together times the root of the
    stride.
    """
    plant, network, search, state = problem.plant, problem.network, problem.search, problem.state
    path, r = problem.path, plant.learned_rows.shape[0]
    n = rolled.points.shape[0] // rolled.ends.shape[0]
    points = rolled.points[first * n : (first + count) * n]
    last = row + points.shape[0] * r
    rows, products = path.rows[row:last], path.products[row:last]
    if path.kernels.shape[0] > 0:
        gp.write_rows(network, state, r, points, rows, products)
        return
    weight = search.row_scale
    if search.score == Score.JOINT:
        weight *= np.sqrt(search.stride)
    rows[:] = rows_of_points(plant, network, state.theta, points)
    if weight != 1.0:
        rows *= weight
    if path.inverse.shape[0] == 0:
        multiply_rows(state.covariance, rows, products)
    elif last > row:
        multiply(rows, path.inverse, products)


@compiled
def _choose(values: Matrix, candidates: Matrix, tie: Vector, u: Vector) -> None:
    """Write the candidate that begins the best plan; ``tie`` decides among equal ones."""
    best, preferred = np.max(values), -np.inf
    for c in range(values.shape[0]):
        along = inner(candidates[c], tie)
        if np.max(values[c]) >= best - TIE_MARGIN * abs(best) and along > preferred:
            preferred = along
            u[:] = candidates[c]
