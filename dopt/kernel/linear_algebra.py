"""The inverse M⁻¹ of the information matrix, and Cholesky factors, in compiled code.

M⁻¹ = A - VᵀV, with A a symmetric matrix of which only the upper triangle is stored and read, and V
a few pending rows, (n, q). A step adds r rows to V; when V is full it is subtracted from A in one
pass over the memory of A, which costs less than a pass in every step. All results are symmetric by
construction.

The loops take two or four rows of A at a time: each entry of a vector is then loaded once for
several products. They run over slices, whose indices the compiler knows to be within bounds.
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled, vectorized
from dopt.kernel.structs import Covariance
from dopt.types import Matrix, Stack, Vector

PENDING_ROWS = 16
"""Rows that ``pending`` has room for; a multiple of 4 because the loops take 4 rows at a time."""

SMALL = 32
"""Largest q for which ``pending`` has room for 4 rows only.

Such a matrix fits into the first-level cache, where a pass over it is fast.
"""


@vectorized
def inner(a: Vector, b: Vector) -> float:
    """Return aᵀb."""
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@vectorized
def add_multiple(y: Vector, factor: float, x: Vector) -> None:
    """Add factor x to y."""
    for i in range(x.shape[0]):
        y[i] += factor * x[i]


@vectorized
def symmetric_product(upper: Matrix, x: Vector, y: Vector) -> None:
    """Write y = A x, (q,), four rows of the upper triangle of A at a time."""
    q = x.shape[0]
    y[:] = 0.0
    blocked = q - q % 4
    for i in range(0, blocked, 4):
        _four_rows(
            upper[i, i + 4 :],
            upper[i + 1, i + 4 :],
            upper[i + 2, i + 4 :],
            upper[i + 3, i + 4 :],
            x[i : i + 4],
            x[i + 4 :],
            y[i : i + 4],
            y[i + 4 :],
        )
        _triangle(upper, x, y, i, i + 4)
    _triangle(upper, x, y, blocked, q)


@vectorized
def _triangle(upper: Matrix, x: Vector, y: Vector, start: int, stop: int) -> None:
    """Add the product with the diagonal block from ``start`` to ``stop``."""
    for i in range(start, stop):
        y[i] += upper[i, i] * x[i]
        for j in range(i + 1, stop):
            y[i] += upper[i, j] * x[j]
            y[j] += upper[i, j] * x[i]


@vectorized
def _four_rows(
    row_0: Vector,
    row_1: Vector,
    row_2: Vector,
    row_3: Vector,
    factors: Vector,
    x: Vector,
    sums: Vector,
    y: Vector,
) -> None:
    """Add rowᵀx to the sums of four rows and the rows' multiples to y."""
    factor_0, factor_1, factor_2, factor_3 = factors[0], factors[1], factors[2], factors[3]
    sum_0, sum_1, sum_2, sum_3 = 0.0, 0.0, 0.0, 0.0
    for j in range(x.shape[0]):
        entry_0, entry_1, entry_2, entry_3 = row_0[j], row_1[j], row_2[j], row_3[j]
        sum_0 += entry_0 * x[j]
        sum_1 += entry_1 * x[j]
        sum_2 += entry_2 * x[j]
        sum_3 += entry_3 * x[j]
        y[j] += entry_0 * factor_0 + entry_1 * factor_1 + entry_2 * factor_2 + entry_3 * factor_3
    sums[0] += sum_0
    sums[1] += sum_1
    sums[2] += sum_2
    sums[3] += sum_3


@vectorized
def symmetric_products(upper: Matrix, x: Vector, z: Vector, y: Vector, w: Vector) -> None:
    """Write y = A x and w = A z, (q,), in one pass over the upper triangle of A."""
    q = x.shape[0]
    y[:] = 0.0
    w[:] = 0.0
    blocked = q - q % 2
    for i in range(0, blocked, 2):
        x_0, x_1, z_0, z_1 = x[i], x[i + 1], z[i], z[i + 1]
        first, second = upper[i, i + 2 :], upper[i + 1, i + 2 :]
        below = (x[i + 2 :], z[i + 2 :], y[i + 2 :], w[i + 2 :])
        sum_x0, sum_x1, sum_z0, sum_z1 = _two_rows(first, second, x_0, x_1, z_0, z_1, *below)
        a, b, c = upper[i, i], upper[i, i + 1], upper[i + 1, i + 1]
        y[i] += sum_x0 + a * x_0 + b * x_1
        y[i + 1] += sum_x1 + b * x_0 + c * x_1
        w[i] += sum_z0 + a * z_0 + b * z_1
        w[i + 1] += sum_z1 + b * z_0 + c * z_1
    _triangle(upper, x, y, blocked, q)
    _triangle(upper, z, w, blocked, q)


@vectorized
def _two_rows(
    row_0: Vector,
    row_1: Vector,
    x_0: float,
    x_1: float,
    z_0: float,
    z_1: float,
    x: Vector,
    z: Vector,
    y: Vector,
    w: Vector,
) -> tuple[float, float, float, float]:
    """Do for two rows and two vectors what :func:`_four_rows` does; return the four sums."""
    sum_x0, sum_x1, sum_z0, sum_z1 = 0.0, 0.0, 0.0, 0.0
    for j in range(x.shape[0]):
        entry_0, entry_1 = row_0[j], row_1[j]
        sum_x0 += entry_0 * x[j]
        sum_x1 += entry_1 * x[j]
        sum_z0 += entry_0 * z[j]
        sum_z1 += entry_1 * z[j]
        y[j] += entry_0 * x_0 + entry_1 * x_1
        w[j] += entry_0 * z_0 + entry_1 * z_1
    return sum_x0, sum_x1, sum_z0, sum_z1


@vectorized
def multiply_rows(covariance: Covariance, rows: Matrix, out: Matrix) -> None:
    """Write M⁻¹ times each row of ``rows``, (k, q)."""
    k = rows.shape[0]
    for i in range(0, k - 1, 2):
        symmetric_products(covariance.upper, rows[i], rows[i + 1], out[i], out[i + 1])
    if k % 2:
        symmetric_product(covariance.upper, rows[k - 1], out[k - 1])
    for n in range(covariance.n_pending[0]):
        pending = covariance.pending[n]
        for i in range(k):
            add_multiple(out[i], -inner(pending, rows[i]), pending)


@vectorized
def quadratic_forms(covariance: Covariance, left: Matrix, right: Matrix) -> Matrix:
    """Return left M⁻¹ rightᵀ for ``left`` (k, q) and ``right`` (n, q)."""
    products = np.empty(left.shape)
    multiply_rows(covariance, left, products)
    out = np.empty((left.shape[0], right.shape[0]))
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = inner(products[i], right[j])
    return out


@vectorized
def rank_update(covariance: Covariance, rows: Matrix, residuals: Vector, scratch: Matrix) -> None:
    """Turn M⁻¹ into (M + JᵀJ)⁻¹ and the residuals e into L⁻¹e (Woodbury identity).

    With V = J M⁻¹ and the Cholesky factor L of I + V Jᵀ, the update is M⁻¹ - (L⁻¹V)ᵀ(L⁻¹V).

    Parameters
    ----------
    covariance : Covariance
        M⁻¹, updated in place.
    rows : (r, q)
        J.
    residuals : (r,)
        e, overwritten by L⁻¹e: ``scratch.T @ residuals`` is then the least-squares correction of θ.
        NaN where the variance J M⁻¹ Jᵀ overflows: division by infinity would give a
        correction of 0, as if θ had converged.
    scratch : (r, q)
        Overwritten by L⁻¹V.
    """
    r = rows.shape[0]
    multiply_rows(covariance, rows, scratch)
    for k in range(r):
        if inner(scratch[k], rows[k]) < 0.0:
            restore(covariance)
            multiply_rows(covariance, rows, scratch)
            break
    L = np.zeros((r, r))
    for k in range(r):
        for i in range(k + 1):
            L[k, i] = inner(scratch[k], rows[i]) + (1.0 if i == k else 0.0)
    _factorize(L)
    for k in range(r):
        row = scratch[k]
        for i in range(k):
            residuals[k] -= L[k, i] * residuals[i]
            add_multiple(row, -L[k, i], scratch[i])
        residuals[k] /= L[k, k] if np.isfinite(L[k, k]) else np.nan
        for j in range(row.shape[0]):
            row[j] /= L[k, k]
        append_row(covariance, row)


@vectorized
def restore(covariance: Covariance) -> None:
    """Make M⁻¹ positive semidefinite again, by a fresh eigendecomposition.

    A negative variance jᵀM⁻¹j is the cheap sign that rounding has destroyed it, which takes a
    regularisation near the resolution of float64.
    """
    upper, pending = covariance.upper, covariance.pending
    q = upper.shape[0]
    full = np.empty((q, q))
    for i in range(q):
        for j in range(i, q):
            value = upper[i, j]
            for k in range(covariance.n_pending[0]):
                value -= pending[k, i] * pending[k, j]
            full[i, j] = value
            full[j, i] = value
    values, axes = np.linalg.eigh(full)
    for i in range(q):
        for j in range(i, q):
            upper[i, j] = 0.0
    for k in range(q):
        if values[k] > 0.0:
            for i in range(q):
                for j in range(i, q):
                    upper[i, j] += values[k] * axes[i, k] * axes[j, k]
    covariance.n_pending[0] = 0


@vectorized
def _factorize(L: Matrix) -> None:
    """Replace the lower triangle of a positive definite matrix, (r, r), by its Cholesky factor."""
    for k in range(L.shape[0]):
        for i in range(k + 1):
            value = L[k, i]
            for j in range(i):
                value -= L[k, j] * L[i, j]
            L[k, i] = np.sqrt(value) if i == k else value / L[i, i]


@vectorized
def append_row(covariance: Covariance, row: Vector) -> None:
    """Add a row to V, and subtract VᵀV from A when that fills it."""
    n = covariance.n_pending[0]
    pending = covariance.pending
    target = pending[n]
    for j in range(row.shape[0]):
        target[j] = row[j]
    n += 1
    if n == pending.shape[0]:
        for i in range(row.shape[0]):
            for k in range(0, n, 4):
                _subtract_four(
                    covariance.upper[i, i:],
                    pending[k : k + 4, i],
                    pending[k, i:],
                    pending[k + 1, i:],
                    pending[k + 2, i:],
                    pending[k + 3, i:],
                )
        n = 0
    covariance.n_pending[0] = n


@vectorized
def _subtract_four(
    row: Vector, factors: Vector, v_0: Vector, v_1: Vector, v_2: Vector, v_3: Vector
) -> None:
    factor_0, factor_1, factor_2, factor_3 = factors[0], factors[1], factors[2], factors[3]
    for j in range(row.shape[0]):
        row[j] -= factor_0 * v_0[j] + factor_1 * v_1[j] + factor_2 * v_2[j] + factor_3 * v_3[j]


def dense(covariance: Covariance) -> Matrix:
    """Return M⁻¹ as a full matrix, (q, q)."""
    upper = np.triu(covariance.upper)
    pending = covariance.pending[: covariance.n_pending[0]]
    full: Matrix = upper + np.triu(upper, 1).T - pending.T @ pending
    return full


BLOCK = 48
"""Rows and columns of a block: three of them fit into the first-level cache."""


@compiled
def factorize(matrix: Matrix) -> bool:
    """Replace a matrix, (q, q), by its factor C; tell whether it is positive definite."""
    try:
        matrix[:] = np.linalg.cholesky(matrix)
    except Exception:  # compiled code catches all exceptions or none
        return False
    return True


@compiled
def solve_lower(factor: Matrix, n_rows: int, right: Matrix) -> None:
    """Replace the first entries of each right-hand side, (k, ·), by the entries of C⁻¹ times it."""
    for i in range(n_rows):
        row = factor[i]
        for k in range(right.shape[0]):
            right[k, i] = (right[k, i] - inner(row[:i], right[k, :i])) / row[i]


@vectorized
def solve_lower_transposed(factor: Matrix, n_rows: int, right: Matrix) -> None:
    """Replace right-hand sides, (k, n), by C⁻ᵀ times them, with C the first n rows and columns."""
    for i in range(n_rows - 1, -1, -1):
        row = factor[i]
        for k in range(right.shape[0]):
            right[k, i] /= row[i]
            add_multiple(right[k, :i], -right[k, i], row[:i])


@vectorized
def solve(factor: Matrix, right: Vector) -> None:
    """Replace a right-hand side, (q,), by (C Cᵀ)⁻¹ times it."""
    q = right.shape[0]
    solve_lower(factor, q, right.reshape(1, q))
    solve_lower_transposed(factor, q, right.reshape(1, q))


@compiled
def solve_columns(factor: Matrix, right: Matrix) -> None:
    """Replace right-hand sides, (q, k), by C⁻¹ times them, block by block."""
    q = factor.shape[0]
    for start in range(0, q, BLOCK):
        stop = min(start + BLOCK, q)
        if start > 0:
            right[start:stop] -= np.dot(factor[start:stop, :start].copy(), right[:start])
        for i in range(start, stop):
            for j in range(start, i):
                add_multiple(right[i], -factor[i, j], right[j])
            _divide(right[i], factor[i, i])


@compiled
def solve_transposed_columns(factor: Matrix, right: Matrix) -> None:
    """Replace right-hand sides, (q, k), by C⁻ᵀ times them, block by block."""
    q = factor.shape[0]
    for start in range((q - 1) // BLOCK * BLOCK, -1, -BLOCK):
        stop = min(start + BLOCK, q)
        if stop < q:
            right[start:stop] -= np.dot(factor[stop:, start:stop].T.copy(), right[stop:])
        for i in range(stop - 1, start - 1, -1):
            for j in range(i + 1, stop):
                add_multiple(right[i], -factor[j, i], right[j])
            _divide(right[i], factor[i, i])


@compiled
def _divide(row: Vector, by: float) -> None:
    for j in range(row.shape[0]):
        row[j] /= by


@compiled
def write_inverse(factor: Matrix, upper: Matrix) -> bool:
    """Write the upper triangle of (C Cᵀ)⁻¹, (q, q); tell whether it is finite.

    X = C⁻¹ and XᵀX, block by block, without the blocks that are zero: q³/3 multiplications.
    """
    n = (factor.shape[0] + BLOCK - 1) // BLOCK
    X = np.zeros((n, n, BLOCK, BLOCK))
    _invert_blocks(factor, X)
    for i in range(n):
        for j in range(i, n):
            block = np.zeros((BLOCK, BLOCK))
            for k in range(j, n):
                block += np.dot(X[k, i].T, X[k, j])
            _write_block(block, i * BLOCK, j * BLOCK, upper)
    return bool(np.isfinite(np.diag(upper)).all())


@compiled
def _invert_blocks(factor: Matrix, X: Stack) -> None:
    """Write the blocks of C⁻¹ on and below the diagonal, padded by the identity."""
    n = X.shape[0]
    C = np.zeros(X.shape)
    for i in range(n):
        for j in range(i + 1):
            _read_block(factor, i * BLOCK, j * BLOCK, C[i, j])
        _invert_triangle(C[i, i], X[i, i])
    for j in range(n):
        for i in range(j + 1, n):
            total = np.zeros((BLOCK, BLOCK))
            for k in range(j, i):
                total += np.dot(C[i, k], X[k, j])
            X[i, j] = -np.dot(X[i, i], total)


@compiled
def _read_block(factor: Matrix, first: int, left: int, block: Matrix) -> None:
    q = factor.shape[0]
    for i in range(BLOCK):
        for j in range(BLOCK):
            if first + i < q and left + j < q and left + j <= first + i:
                block[i, j] = factor[first + i, left + j]
        if first == left and first + i >= q:
            block[i, i] = 1.0


@vectorized
def _invert_triangle(C: Matrix, X: Matrix) -> None:
    """Write the inverse of a lower triangular block, row by row."""
    for i in range(C.shape[0]):
        row = X[i]
        for k in range(i):
            other, factor = X[k], C[i, k]
            for j in range(k + 1):
                row[j] -= factor * other[j]
        for j in range(i):
            row[j] /= C[i, i]
        row[i] = 1.0 / C[i, i]


@compiled
def _write_block(block: Matrix, first: int, left: int, upper: Matrix) -> None:
    q = upper.shape[0]
    for i in range(min(BLOCK, q - first)):
        for j in range(min(BLOCK, q - left)):
            if left + j >= first + i:
                upper[first + i, left + j] = block[i, j]
