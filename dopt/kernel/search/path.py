"""Paths of the learned model and the rows of J along them, in compiled code.

Legend beside :mod:`dopt.kernel.structs`: H steps of a plan, R rows of a state, n rows along a path.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.algorithm import ModelKind, Score
from dopt.kernel import network as nn
from dopt.kernel.checks import within
from dopt.kernel.compiler import compiled, vectorized
from dopt.kernel.information.primal import add_multiple, inner, multiply_rows
from dopt.kernel.model import add_linear, euler_step, model_accelerations, regressors, rows_at
from dopt.kernel.points import model_point, n_next_points, next_points
from dopt.kernel.state_structs import Covariance
from dopt.kernel.structs import Network, Plant, Search
from dopt.types import Matrix, Vector

FEW_ROWS = 24
"""Up to so many products a step, a full copy of M⁻¹ for the linear algebra library does not pay."""


class Path(NamedTuple):
    """A path in the making; written in place."""

    states: Matrix  # (H + 1, d)
    outputs: Matrix  # (H + 1, r), a_θ at the states
    rows: Matrix  # (n + R, q), J/√ρ along the path; the last R are spare
    products: Matrix  # (n, q), J M⁻¹, or L⁻¹ J M⁻¹ once a score has needed it
    factor: Matrix  # (n, n), the Cholesky factor L of I + J M⁻¹ Jᵀ in the lower triangle
    inverse: Matrix  # (q, q), A of M⁻¹ = A - VᵀV; empty where few products are needed
    flow: Vector  # (d,)
    u: Vector  # (m,) input that counts at a state, where the model reads inputs
    phi: Vector  # (p,)
    hidden: Matrix  # (L, w)
    deltas: Matrix  # (L, w)


@compiled
def new_path(
    plant: Plant, network: Network, search: Search, covariance: Covariance, d: int
) -> Path:
    """Return an empty path."""
    r, q = plant.learned_rows.shape[0], covariance.upper.shape[0]
    C, H, R = search.candidates.shape[0], search.steps, rows_of_state(plant, network)
    n = R * (H // search.stride)
    size = q if n * C > FEW_ROWS else 0
    path = Path(
        np.empty((H + 1, d)),
        np.empty((H + 1, r)),
        np.empty((n + R, q)),
        np.empty((n, q)),
        np.zeros((n, n)),
        np.empty((size, size)),
        np.empty(d),
        np.zeros(plant.n_inputs),
        np.empty(network.feature_kinds.shape[0]),
        np.empty((network.offsets.shape[0] - 1, network.sizes[1])),
        np.empty((network.offsets.shape[0] - 1, network.sizes[1])),
    )
    for i in range(size):
        for j in range(i, size):
            path.inverse[i, j] = covariance.upper[i, j]
            path.inverse[j, i] = covariance.upper[i, j]
    return path


@compiled
def rows_of_state(plant: Plant, network: Network) -> int:
    """Return R, the number of rows of J that belong to one state of a path."""
    count: int = plant.learned_rows.shape[0] * n_next_points(network)
    return count


@compiled
def model_and_jacobian(
    plant: Plant, network: Network, theta: Vector, path: Path, i: int, rows: Matrix
) -> None:
    """Write a_θ, under the present input, and the rows of J at state i of the path, (R, q).

    For a model that reads inputs the rows are those of :func:`next_points`, weighted so that the
    sum of their JᵀJ is the mean.
    """
    x, out = path.states[i], path.outputs[i]
    if network.n_inputs_read > 0:
        model_accelerations(plant, network, theta, model_point(network, x, path.u), out)
        if rows.shape[0] > 0:
            points = next_points(network, x, plant.gamma)
            rows[:] = rows_at(plant, network, theta, points)
            scale(rows, 1.0 / np.sqrt(points.shape[0]))
        return
    if network.kind != ModelKind.MLP:
        regressors(plant, network, x, rows, out)
        add_linear(rows, theta, out)
        return
    nn.features_at(network, x, path.phi)
    nn.activations_at(network, theta, path.phi, path.hidden, out)
    for k in range(rows.shape[0]):
        nn.back_signals(network, theta, path.phi, path.hidden, k, path.deltas)
        nn.parameter_gradient(network, path.phi, path.hidden, path.deltas, k, rows[k])


@compiled
def rollout(
    plant: Plant,
    network: Network,
    search: Search,
    theta: Vector,
    path: Path,
    u: Vector,
    first: int,
    last: int,
) -> bool:
    """Hold u from state ``first`` of the path to state ``last``; tell whether it stays in bounds.

    x_{i+1} = x_i + dt f_θ(x_i, u). The rows of J at every stride-th state are written in the units
    of M, for the determinant of all of them together times the root of the stride.
    """
    R, stride = rows_of_state(plant, network), search.stride
    spare = path.products.shape[0]
    if network.n_inputs_read > 0:
        path.u[:] = u
        point = model_point(network, path.states[first], u)
        model_accelerations(plant, network, theta, point, path.outputs[first])
    for i in range(first, last):
        x, following = path.states[i], path.states[i + 1]
        euler_step(plant, x, u, path.outputs[i], path.flow, following)
        if not within(following, plant.state_limit):
            return False
        wanted = (i + 1) % stride == 0
        block = R * ((i + 1) // stride - 1) if wanted else spare
        # A network's output comes without rows; those of a linear model are its output.
        count = R if wanted or network.kind != ModelKind.MLP else 0
        rows = path.rows[block : block + count]
        model_and_jacobian(plant, network, theta, path, i + 1, rows)
        weight = search.row_scale
        if stride > 1 and search.score == Score.JOINT:
            weight *= np.sqrt(stride)
        if weight != 1.0:
            scale(rows, weight)
    return True


@compiled
def scale(rows: Matrix, factor: float) -> None:
    """Multiply a matrix by a number in place."""
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            rows[i, j] *= factor


@vectorized
def apply_inverse(covariance: Covariance, path: Path, first: int, last: int) -> None:
    """Write the products of rows ``first`` to ``last`` with M⁻¹."""
    rows, out = path.rows[first:last], path.products[first:last]
    if path.inverse.shape[0] == 0:
        multiply_rows(covariance, rows, out)
        return
    np.dot(rows, path.inverse, out)
    for n in range(covariance.n_pending[0]):
        pending = covariance.pending[n]
        for i in range(rows.shape[0]):
            add_multiple(out[i], -inner(pending, rows[i]), pending)


@vectorized
def log_determinant(path: Path, first: int, last: int, block: int) -> float:
    """Extend the factor L by rows ``first`` to ``last``; return the growth of log det.

    Only rows of the same block of so many are taken together: all of them for the determinant of
    the whole path, r for those of its states one by one.
    """
    L = path.factor
    total = 0.0
    for i in range(first, last):
        start = i - i % block
        for j in range(start, i + 1):
            value = inner(path.products[i], path.rows[j])
            value -= inner(L[i, start:j], L[j, start:j])
            L[i, j] = np.sqrt(1.0 + value) if i == j else value / L[j, j]
        total += 2.0 * np.log(L[i, i])
    return total


@vectorized
def whiten(path: Path, n: int) -> None:
    """Replace the first n products V by L⁻¹V, given the factor."""
    for i in range(n):
        row = path.products[i]
        for j in range(i):
            add_multiple(row, -path.factor[i, j], path.products[j])
        for j in range(row.shape[0]):
            row[j] /= path.factor[i, i]
