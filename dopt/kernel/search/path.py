"""Paths of a search in compiled code: states, rows of J, their products with M⁻¹, and scores.

Sizes beside :mod:`dopt.kernel.structs`: H steps of a plan, C candidates, R rows of a state, n rows
along a path; P paths that advance together, K inputs of a path, n states of a path that are kept.
The model is evaluated at all paths at once, which costs less than one after the other. The largest
eigenvalue of M⁻¹ is taken from a block Krylov space.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.algorithm import INVARIANT, ModelKind, Score
from dopt.kernel import gaussian_process as gp
from dopt.kernel.compiler import compiled, squared
from dopt.kernel.linear_algebra import multiply_rows, write_dense
from dopt.kernel.model import (
    accelerations_at,
    euler_step,
    n_next_points,
    next_points,
    rows_at,
    within,
)
from dopt.kernel.structs import Covariance, Network, Plant, Search, State
from dopt.kernel.vectors import add_multiple, inner, multiply, product
from dopt.types import Booleans, Matrix, Stack, Vector


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
