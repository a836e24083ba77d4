"""Rows of J along a path of the learned model and their products with M⁻¹, in compiled code.

Legend beside :mod:`dopt.kernel.structs`: H steps of a plan, C candidates, R rows of a state, n rows
along a path.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.algorithm import Score
from dopt.kernel.compiler import compiled, vectorized
from dopt.kernel.information.primal import add_multiple, inner, multiply_rows
from dopt.kernel.model import rows_at
from dopt.kernel.points import n_next_points
from dopt.kernel.state_structs import Covariance
from dopt.kernel.structs import Network, Plant, Search
from dopt.types import Matrix, Vector

FEW_ROWS = 40
"""Up to so many products a step, a full copy of M⁻¹ for the linear algebra library does not pay."""

BLOCK = 16
"""Rows and columns of M⁻¹ that are copied to their mirror image at a time."""


class Path(NamedTuple):
    """Rows along paths that share what comes before the switch; written in place.

    A path has n states whose rows count, b of them before the switch, and there are C paths.
    """

    rows: Matrix  # (R (b + C (n - b)), q), J/√ρ before the switch, then after it path by path
    products: Matrix  # of the same size, J M⁻¹
    factor: Matrix  # (R n, R n), the Cholesky factor L of I + J M⁻¹ Jᵀ of one path
    inverse: Matrix  # (q, q), M⁻¹; empty where few products are needed


class Place(NamedTuple):
    """Place of the rows of one path among those of all."""

    shared: int  # R b
    offset: int  # by which the rows after these are moved


@compiled
def new_path(plant: Plant, network: Network, search: Search, covariance: Covariance) -> Path:
    """Return an empty path."""
    q, R, C = covariance.upper.shape[0], rows_of_state(plant, network), search.candidates.shape[0]
    n, shared = search.steps // search.stride, switch_of(search) // search.stride
    starts = C if shared > 0 else 1
    size = q if R * starts * (shared + C * (n - shared)) > FEW_ROWS else 0
    inverse, count = np.empty((size, size)), R * (shared + C * (n - shared))
    if size > 0:
        _write_dense(covariance, inverse)
    return Path(np.empty((count, q)), np.empty((count, q)), np.zeros((R * n, R * n)), inverse)


@compiled
def switch_of(search: Search) -> int:
    """Return the step at which the input switches, 0 where it never does."""
    step: int = search.switch if search.switch < search.steps else 0
    return step


@vectorized
def _write_dense(covariance: Covariance, out: Matrix) -> None:
    """Write M⁻¹ as a full matrix, (q, q)."""
    q = out.shape[0]
    for i in range(q):
        row = out[i, i:]
        for j in range(row.shape[0]):
            row[j] = covariance.upper[i, i + j]
        for n in range(covariance.n_pending[0]):
            add_multiple(row, -covariance.pending[n, i], covariance.pending[n, i:])
    for first in range(0, q, BLOCK):
        for i in range(first, q):
            for j in range(first, min(first + BLOCK, i)):
                out[i, j] = out[j, i]


@compiled
def rows_of_state(plant: Plant, network: Network) -> int:
    """Return R, the number of rows of J that belong to one state of a path."""
    count: int = plant.learned_rows.shape[0] * n_next_points(network)
    return count


@compiled
def rows_of_points(plant: Plant, network: Network, theta: Vector, points: Matrix) -> Matrix:
    """Return the rows of J at the points of states, one state after the other.

    Where several points stand for a state (:mod:`dopt.kernel.points`) their rows are weighted so
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
    theta: Vector,
    covariance: Covariance,
    points: Matrix,
    path: Path,
    first: int,
) -> None:
    """Write the rows at points and their products with M⁻¹, from row ``first``.

    They are in the units of M, for the determinant of all of them together times the root of the
    stride.
    """
    weight = search.row_scale
    if search.score == Score.JOINT:
        weight *= np.sqrt(search.stride)
    last: int = first + points.shape[0] * plant.learned_rows.shape[0]
    rows = path.rows[first:last]
    rows[:] = rows_of_points(plant, network, theta, points)
    if weight != 1.0:
        rows *= weight
    _apply_inverse(covariance, path, first, last)


@compiled
def _apply_inverse(covariance: Covariance, path: Path, first: int, last: int) -> None:
    """Write the products of rows ``first`` to ``last`` with M⁻¹."""
    if path.inverse.shape[0] == 0:
        multiply_rows(covariance, path.rows[first:last], path.products[first:last])
    elif last > first:
        np.dot(path.rows[first:last], path.inverse, path.products[first:last])


@compiled
def row_at(place: Place, i: int) -> int:
    """Return where the i-th row of a path is."""
    return i if i < place.shared else i + place.offset


@vectorized
def log_determinant(path: Path, place: Place, first: int, last: int, block: int) -> float:
    """Extend the factor L by rows ``first`` to ``last`` of a path; return the growth of log det.

    Only rows of the same block of so many are taken together: all of them for the determinant of
    the whole path, r for those of its states one by one.
    """
    L = path.factor
    total = 0.0
    for i in range(first, last):
        start, products = i - i % block, path.products[row_at(place, i)]
        for j in range(start, i + 1):
            value = inner(products, path.rows[row_at(place, j)])
            value -= inner(L[i, start:j], L[j, start:j])
            L[i, j] = np.sqrt(1.0 + value) if i == j else value / L[j, j]
        total += 2.0 * np.log(L[i, i])
    return total


@vectorized
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
