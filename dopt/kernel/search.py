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

from dopt.algorithm import INVARIANT, TIE_MARGIN, ModelKind, Score
from dopt.kernel import gaussian_process as gp
from dopt.kernel.compiler import compiled, monotonic_microseconds, squared
from dopt.kernel.linear_algebra import multiply_rows, write_dense
from dopt.kernel.model import (
    accelerations_at,
    euler_step,
    n_next_points,
    next_points,
    rows_at,
    within,
)
from dopt.kernel.network import multiply_vector
from dopt.kernel.structs import Covariance, Network, Plant, Search, State, Trial
from dopt.kernel.vectors import add_multiple, inner, multiply, product
from dopt.types import Booleans, Integers, Matrix, Stack, Vector


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
"""Up to so many products a step, a full copy of M⁻¹ for the linear algebra library does not pay."""


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


class Place(NamedTuple):
    """Place of the rows of one path among the rows of all paths."""

    shared: int  # R b
    offset: int  # by which the rows after these are moved


@compiled
def new_path(plant: Plant, network: Network, search: Search, state: State) -> Path:
    """Return an empty path."""
    covariance, q, p = state.covariance, state.covariance.size, state.covariance.size
    kernels = np.empty((0, 0))
    if network.kind == ModelKind.GAUSSIAN_PROCESS:
        q, p = network.process.n_samples[0], network.sizes[0]
        kernels = gp.numbers_by_row(network, state.theta, plant.learned_rows.shape[0])
    R, C = rows_of_state(plant, network), search.candidates.shape[0]
    n, shared = search.steps // search.stride, switch_of(search) // search.stride
    starts = C if shared > 0 else 1
    size = covariance.size if R * starts * (shared + C * (n - shared)) > FEW_ROWS else 0
    inverse, count = np.empty((size, size)), R * (shared + C * (n - shared))
    if size > 0:
        write_dense(covariance, inverse)
    weight = float(search.stride) if search.score == Score.JOINT else 1.0
    factor = np.zeros((R * n, R * n))
    return Path(np.empty((count, q)), np.empty((count, p)), factor, inverse, kernels, weight)


@compiled
def switch_of(search: Search) -> int:
    """Return the step at which the input switches, 0 where it never does."""
    step: int = search.switch if search.switch < search.steps else 0
    return step


@compiled
def rows_of_state(plant: Plant, network: Network) -> int:
    """Return R, the number of rows of J that belong to one state of a path."""
    count: int = plant.learned_rows.shape[0] * n_next_points(network)
    return count


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
def add_rows(
    plant: Plant,
    network: Network,
    search: Search,
    state: State,
    points: Matrix,
    path: Path,
    first: int,
) -> None:
    """Write the rows at points and their products with M⁻¹, from row ``first``.

    They are in the units of M, for the determinant of all of them together times the root of the
    stride.
    """
    if path.kernels.shape[0] > 0:
        r = plant.learned_rows.shape[0]
        gp.write_rows(network, state, r, points, path.rows[first:], path.products[first:])
        return
    weight = search.row_scale
    if search.score == Score.JOINT:
        weight *= np.sqrt(search.stride)
    last: int = first + points.shape[0] * plant.learned_rows.shape[0]
    rows = path.rows[first:last]
    rows[:] = rows_of_points(plant, network, state.theta, points)
    if weight != 1.0:
        rows *= weight
    _apply_inverse(state.covariance, path, first, last)


@compiled
def _apply_inverse(covariance: Covariance, path: Path, first: int, last: int) -> None:
    """Write the products of rows ``first`` to ``last`` with M⁻¹."""
    if path.inverse.shape[0] == 0:
        multiply_rows(covariance, path.rows[first:last], path.products[first:last])
    elif last > first:
        multiply(path.rows[first:last], path.inverse, path.products[first:last])


@compiled
def row_at(place: Place, i: int) -> int:
    """Return where the i-th row of a path is."""
    return i if i < place.shared else i + place.offset


@compiled
def log_determinant(path: Path, place: Place, first: int, last: int, block: int) -> float:
    """Extend the factor L by rows ``first`` to ``last`` of a path; return the growth of log det.

    Only rows of the same block of so many are taken together: all of them for the determinant of
    the whole path, r for its states one by one.
    """
    L = path.factor
    total = 0.0
    for i in range(first, last):
        start = i - i % block
        for j in range(start, i + 1):
            value = _product_of_rows(path, place, i, j)
            value -= inner(L[i, start:j], L[j, start:j])
            L[i, j] = np.sqrt(1.0 + value) if i == j else value / L[j, j]
        total += 2.0 * np.log(L[i, i])
    return total


@compiled
def _product_of_rows(path: Path, place: Place, i: int, j: int) -> float:
    """Return J M⁻¹ Jᵀ of the i-th and the j-th row of a path."""
    a, b = row_at(place, i), row_at(place, j)
    value: float
    if path.kernels.shape[0] == 0:
        value = inner(path.products[a], path.rows[b])
    else:
        value = path.weight * gp.information(path.kernels, path.products, path.rows, a, b)
    return value


@compiled
def whitened(path: Path, place: Place) -> Matrix:
    """Return L⁻¹ J M⁻¹, (R n, q), of a path whose factor is known."""
    n = path.factor.shape[0]
    out = np.empty((n, path.products.shape[1]))
    for i in range(n):
        row = out[i]
        row[:] = path.products[row_at(place, i)]
        for j in range(i):
            add_multiple(row, -path.factor[i, j], out[j])
        for j in range(row.shape[0]):
            row[j] /= path.factor[i, i]
    return out


class Paths(NamedTuple):
    """Paths at their present step; written in place."""

    states: Matrix  # (P, d)
    inside: Booleans  # (P,), whether all states so far are within bounds
    points: Matrix  # (P, ·), what the model depends on: the states, or states and inputs
    outputs: Matrix  # (r, P), a_θ there
    value: Vector  # (r,), of one path
    flow: Vector  # (d,)
    following: Vector  # (d,)


@compiled
def paths_from(plant: Plant, network: Network, starts: Matrix) -> Paths:
    """Return paths that start at states, (P, d)."""
    (P, d), r = starts.shape, plant.learned_rows.shape[0]
    states = starts.copy()
    return Paths(
        states,
        np.ones(P, np.bool_),
        states if network.n_inputs_read == 0 else np.empty((P, d + network.n_inputs_read)),
        np.empty((r, P)),
        np.empty(r),
        np.empty(d),
        np.empty(d),
    )


@compiled
def advance_paths(
    plant: Plant, network: Network, theta: Vector, paths: Paths, inputs: Stack, k: int
) -> None:
    """Take every path one step x + dt f_θ(x, u) further under its k-th input of (P, K, m)."""
    P, d = paths.states.shape
    if network.n_inputs_read > 0:
        paths.points[:, :d] = paths.states
        paths.points[:, d:] = inputs[:, k]
    accelerations_at(plant, network, theta, paths.points, paths.outputs)
    for p in range(P):
        for j in range(paths.value.shape[0]):
            paths.value[j] = paths.outputs[j, p]
        euler_step(plant, paths.states[p], inputs[p, k], paths.value, paths.flow, paths.following)
        paths.inside[p] = paths.inside[p] and within(paths.following, plant.state_limit)
        for j in range(d):
            paths.states[p, j] = paths.following[j]


@compiled
def keep_points(plant: Plant, network: Network, paths: Paths, i: int, n: int, kept: Matrix) -> None:
    """Write the points of the present states as the i-th of n of every path.

    They are :func:`dopt.kernel.model.next_points`, path by path.
    """
    per_state = n_next_points(network)
    for p in range(paths.states.shape[0]):
        place = per_state * (p * n + i)
        points = next_points(network, paths.states[p], plant.gamma)
        kept[place : place + per_state] = points


class ScoreContext(NamedTuple):
    """Arrays that a score needs beside the path; empty where it needs none."""

    probes: Matrix  # (n, q), J at the task's states or the basis of the Krylov space
    projected: Matrix  # (K, K), M⁻¹ in the Krylov space


@compiled
def score_of_path(score: int, path: Path, place: Place, context: ScoreContext) -> float:
    """Return the score of a whole path whose factor is known, if it is not a determinant."""
    n, total = path.factor.shape[0], 0.0
    if score == Score.TRACE:
        for i in range(n):
            total += _product_of_rows(path, place, i, i)
        return total
    white = whitened(path, place)
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
    n = search.task_states.shape[0] if search.score == Score.TASK else 0
    per_state = n_next_points(network)
    points = np.empty((n * per_state, search.task_states.shape[1] + network.n_inputs_read))
    for s in range(n):
        at = next_points(network, search.task_states[s], plant.gamma)
        points[s * per_state : (s + 1) * per_state] = at
    return ScoreContext(rows_of_points(plant, network, theta, points), np.empty((0, 0)))


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
