"""The inverse M⁻¹ of the information matrix, and Cholesky factors, in compiled code.

M⁻¹ = A - VᵀV, with A a symmetric matrix of which the upper triangle is stored and read, in blocks
of eight rows and columns, and V a few pending rows, (n, q). A step adds r rows to V; when V is full
it is subtracted from A in one pass over the memory of A, which costs less than a pass in every
step. All results are symmetric by construction.

The rows that a state adds to M may be deferred: they are multiplied by M⁻¹ in the pass that the
next plan needs anyway. Whatever reads M⁻¹ settles them first. A product has the same bits whichever
rows share its pass (:mod:`dopt.kernel.vectors`).
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled, copy_into
from dopt.kernel.structs import Covariance
from dopt.kernel.vectors import (
    GROUP,
    LANES,
    add_multiple,
    add_symmetric,
    aligned_zeros,
    inner,
    inner_products,
    padded,
    subtract_product,
    subtract_symmetric,
    symmetric_products,
)
from dopt.types import Matrix, Vector

PENDING_ROWS = 16
"""Rows that ``pending`` has room for, unless a state adds more."""

SMALL = 32
"""Largest q for which ``pending`` has room for 4 rows only.

Such a matrix fits into the first-level cache, where a pass over it is fast.
"""


def initial_covariance(q: int, regularization: float, n_rows: int, n_planned: int) -> Covariance:
    """Return M⁻¹ = I/λ, (q, q), where a state adds so many rows and a plan multiplies so many."""
    upper = aligned_zeros(padded(q), padded(q))
    upper[range(q), range(q)] = 1.0 / regularization
    room, together = max(PENDING_ROWS if q > SMALL else 4, n_rows), max(n_rows + n_planned, GROUP)
    pending, rows, products = (aligned_zeros(n, padded(q)) for n in (room, together, together))
    n_pending, n_deferred = np.zeros((2, 1), dtype=np.int64)
    return Covariance(upper, pending, rows, products, n_pending, n_deferred, q)


@compiled
def multiply_planned(covariance: Covariance, k: int) -> Matrix:
    """Return M⁻¹ times the k rows behind the deferred ones, as a view, (k, padded q).

    The deferred ones are added to M before, in the same pass over A.
    """
    return _multiply_and_add(covariance, k, np.zeros(covariance.n_deferred[0]))


@compiled
def settle(covariance: Covariance) -> None:
    """Add the deferred rows to M."""
    if covariance.n_deferred[0] > 0:
        multiply_planned(covariance, 0)


@compiled
def _multiply_and_add(covariance: Covariance, k: int, residuals: Vector) -> Matrix:
    """As :func:`multiply_planned`; the residuals e of the deferred rows become L⁻¹e."""
    n = covariance.n_deferred[0]
    _make_room(covariance, n)
    rows, products = covariance.rows[: n + k], covariance.products[: n + k]
    _multiply(covariance, rows, products)
    for i in range(n):
        if inner(products[i], rows[i]) < 0.0:
            restore(covariance)
            _multiply(covariance, rows, products)
            break
    first = covariance.n_pending[0]
    if n > 0:
        _add_pending(covariance, residuals)
        _subtract_pending(covariance.pending[first : first + n], rows[n:], products[n:])
    return products[n:]


@compiled
def _multiply(covariance: Covariance, rows: Matrix, products: Matrix) -> None:
    """Write M⁻¹ times each row of ``rows``, (k, padded q)."""
    symmetric_products(covariance.upper, rows, products)
    _subtract_pending(covariance.pending[: covariance.n_pending[0]], rows, products)


@compiled
def _subtract_pending(pending: Matrix, rows: Matrix, products: Matrix) -> None:
    """Subtract VᵀV times each row, (k, padded q), from its product."""
    parts = np.empty((pending.shape[0], rows.shape[0]))
    inner_products(pending, rows, parts)
    subtract_product(parts.T, pending, products)


@compiled
def _add_pending(covariance: Covariance, residuals: Vector) -> None:
    """Add the deferred rows J, whose products are known, to M, and turn e into L⁻¹e.

    With V = J M⁻¹ and the Cholesky factor L of I + V Jᵀ, the rows of L⁻¹V become pending.
    """
    r, first = residuals.shape[0], covariance.n_pending[0]
    rows, added = covariance.products[:r], covariance.pending[first : first + r]
    L = np.empty((r, r))
    inner_products(rows, covariance.rows[:r], L)
    for k in range(r):
        L[k, k] += 1.0
    definite = factorize(L)
    for k in range(r):
        row = added[k]
        copy_into(rows[k], row)
        for i in range(k):
            residuals[k] -= L[k, i] * residuals[i]
            add_multiple(row, -L[k, i], added[i])
        pivot = L[k, k] if definite else np.nan
        residuals[k] /= pivot if np.isfinite(pivot) else np.nan
        scale = 1.0 / pivot
        for j in range(row.shape[0]):
            row[j] *= scale
    covariance.n_pending[0] = first + r
    covariance.n_deferred[0] = 0


@compiled
def multiply_rows(covariance: Covariance, rows: Matrix, out: Matrix) -> None:
    """Write M⁻¹ times each row of ``rows``, (k, q)."""
    settle(covariance)
    k = rows.shape[0]
    for first in range(0, k, GROUP):
        n = min(GROUP, k - first)
        for i in range(n):
            copy_into(rows[first + i], covariance.rows[i])
        products = multiply_planned(covariance, n)
        for i in range(n):
            copy_into(products[i, : covariance.size], out[first + i])


@compiled
def quadratic_forms(covariance: Covariance, left: Matrix, right: Matrix) -> Matrix:
    """Return left M⁻¹ rightᵀ for ``left`` (k, q) and ``right`` (n, q)."""
    products, out = np.empty(left.shape), np.empty((left.shape[0], right.shape[0]))
    multiply_rows(covariance, left, products)
    inner_products(products, right, out)
    return out


@compiled
def rank_update(covariance: Covariance, rows: Matrix, residuals: Vector) -> Vector:
    """Turn M⁻¹ into (M + JᵀJ)⁻¹ (Woodbury identity); return the least-squares correction of θ.

    Parameters
    ----------
    covariance : Covariance
        M⁻¹, updated in place.
    rows : (r, q)
        J.
    residuals : (r,)
        e, overwritten by what the rows before have left of it, over its deviation.

    Returns
    -------
    (q,)
        (M + JᵀJ)⁻¹Jᵀe. NaN where the variance J M⁻¹ Jᵀ overflows: division by infinity would give a
        correction of 0, as if θ had converged.
    """
    settle(covariance)
    r, room = rows.shape[0], min(covariance.pending.shape[0], covariance.rows.shape[0])
    correction = np.zeros(covariance.size)
    for first in range(0, r, room):
        n = min(room, r - first)
        for i in range(n):
            copy_into(rows[first + i], covariance.rows[i])
            residuals[first + i] -= inner(rows[first + i], correction)
        covariance.n_deferred[0] = n
        _multiply_and_add(covariance, 0, residuals[first : first + n])
        last = covariance.n_pending[0]
        for i in range(n):
            row = covariance.pending[last - n + i, : covariance.size]
            add_multiple(correction, residuals[first + i], row)
    return correction


@compiled
def append_row(covariance: Covariance, row: Vector) -> None:
    """Subtract wᵀw from M⁻¹ for a row w, (q,)."""
    settle(covariance)
    _make_room(covariance, 1)
    n = covariance.n_pending[0]
    copy_into(row, covariance.pending[n])
    covariance.n_pending[0] = n + 1


@compiled
def _make_room(covariance: Covariance, n: int) -> None:
    """Subtract VᵀV from A unless V has room for n more rows."""
    if covariance.n_pending[0] + n > covariance.pending.shape[0]:
        pending = covariance.pending[: covariance.n_pending[0]]
        subtract_symmetric(pending.T, pending, covariance.upper)
        covariance.n_pending[0] = 0


@compiled
def restore(covariance: Covariance) -> None:
    """Make M⁻¹ positive semidefinite again, by a fresh eigendecomposition; rows stay deferred.

    A negative variance jᵀM⁻¹j is the cheap sign that rounding has destroyed it, which takes a
    regularisation near the resolution of float64.
    """
    q = covariance.size
    full, upper = np.empty((q, q)), covariance.upper
    _write_dense(covariance, full)
    values, axes = np.linalg.eigh(full)
    upper[:] = 0.0
    for k in range(q):
        if values[k] > 0.0:
            for i in range(q):
                for j in range(i, q):
                    upper[i, j] += values[k] * axes[i, k] * axes[j, k]
    replaced(covariance)


@compiled
def replaced(covariance: Covariance) -> None:
    """Complete the diagonal blocks of a new upper triangle, and drop pending rows."""
    upper = covariance.upper
    for i in range(upper.shape[0]):
        for j in range(i - i % LANES, i):
            upper[i, j] = upper[j, i]
    covariance.n_pending[0] = 0


@compiled
def write_dense(covariance: Covariance, out: Matrix) -> None:
    """Write M⁻¹ as a full matrix, (q, q)."""
    settle(covariance)
    _write_dense(covariance, out)


MIRRORED = 16
"""Rows and columns that are copied to their mirror image at a time."""


@compiled
def _write_dense(covariance: Covariance, out: Matrix) -> None:
    q, pending = out.shape[0], covariance.pending[: covariance.n_pending[0], : out.shape[0]]
    for i in range(q):
        copy_into(covariance.upper[i, i:q], out[i, i:])
    subtract_symmetric(pending.T, pending, out)
    for first in range(0, q, MIRRORED):
        for i in range(first, q):
            for j in range(first, min(first + MIRRORED, i)):
                out[i, j] = out[j, i]


def dense(covariance: Covariance) -> Matrix:
    """Return M⁻¹ as a full matrix, (q, q); deferred rows stay so."""
    q, J = covariance.size, covariance.rows[: covariance.n_deferred[0], : covariance.size]
    upper = np.triu(covariance.upper[:q, :q])
    pending = covariance.pending[: covariance.n_pending[0], :q]
    full: Matrix = upper + np.triu(upper, 1).T - pending.T @ pending
    products = J @ full
    added = np.linalg.solve(np.linalg.cholesky(np.eye(len(J)) + products @ J.T), products)
    full -= added.T @ added
    return full


PANEL = 32
"""Rows of a factor that are eliminated together; a multiple of the lanes of a vector."""


@compiled
def factorize(matrix: Matrix) -> bool:
    """Replace a symmetric matrix, (q, q), by its factor C; return whether it is positive definite.

    The upper triangle is read. It becomes Cᵀ, panel by panel, before C takes its place.
    """
    q = matrix.shape[0]
    for start in range(0, q, PANEL):
        stop = min(start + PANEL, q)
        for i in range(start, stop):
            above = matrix[start:i, i:]
            subtract_product(above[:, :1].T, above, matrix[i : i + 1, i:])
            if not matrix[i, i] > 0.0:
                return False
            _divide(matrix[i, i:], np.sqrt(matrix[i, i]))
        panel = matrix[start:stop, stop:]
        subtract_symmetric(panel.T, panel, matrix[stop:, stop:])
    for i in range(q):
        for j in range(i):
            matrix[i, j] = matrix[j, i]
            matrix[j, i] = 0.0
    return True


@compiled
def solve_lower(factor: Matrix, n_rows: int, right: Matrix) -> None:
    """Replace the first entries of each right-hand side, (k, ·), by the entries of C⁻¹ times it."""
    for i in range(n_rows):
        row = factor[i]
        for k in range(right.shape[0]):
            right[k, i] = (right[k, i] - inner(row[:i], right[k, :i])) / row[i]


@compiled
def solve_lower_transposed(factor: Matrix, n_rows: int, right: Matrix) -> None:
    """Replace right-hand sides, (k, n), by C⁻ᵀ times them, with C the first n rows and columns."""
    for i in range(n_rows - 1, -1, -1):
        row = factor[i]
        for k in range(right.shape[0]):
            right[k, i] /= row[i]
            add_multiple(right[k, :i], -right[k, i], row[:i])


@compiled
def solve(factor: Matrix, right: Vector) -> None:
    """Replace a right-hand side, (q,), by (C Cᵀ)⁻¹ times it."""
    q = right.shape[0]
    solve_lower(factor, q, right.reshape(1, q))
    solve_lower_transposed(factor, q, right.reshape(1, q))


@compiled
def solve_columns(factor: Matrix, right: Matrix) -> None:
    """Replace right-hand sides, (q, k), by C⁻¹ times them."""
    q = factor.shape[0]
    for start in range(0, q, PANEL):
        stop = min(start + PANEL, q)
        subtract_product(factor[start:stop, :start], right[:start], right[start:stop])
        _solve_panel(factor, start, stop, right, right.shape[1])


@compiled
def _solve_panel(factor: Matrix, start: int, stop: int, right: Matrix, k: int) -> None:
    """Eliminate rows of k right-hand sides by each other, those from ``start`` to ``stop``."""
    for i in range(start, stop):
        subtract_product(factor[i : i + 1, start:i], right[start:i, :k], right[i : i + 1, :k])
        _divide(right[i, :k], factor[i, i])


@compiled
def solve_transposed_columns(factor: Matrix, right: Matrix) -> None:
    """Replace right-hand sides, (q, k), by C⁻ᵀ times them."""
    q = factor.shape[0]
    for start in range((q - 1) // PANEL * PANEL, -1, -PANEL):
        stop = min(start + PANEL, q)
        subtract_product(factor[stop:, start:stop].T, right[stop:], right[start:stop])
        for i in range(stop - 1, start - 1, -1):
            below = factor[i + 1 : stop, i : i + 1].T
            subtract_product(below, right[i + 1 : stop], right[i : i + 1])
            _divide(right[i], factor[i, i])


@compiled
def _divide(row: Vector, by: float) -> None:
    for j in range(row.shape[0]):
        row[j] /= by


@compiled
def write_inverse(factor: Matrix, out: Matrix) -> bool:
    """Write the upper triangle of (C Cᵀ)⁻¹ into a matrix of at least (q, q).

    Returns whether it is finite. With X = C⁻¹ it is XᵀX; neither is multiplied where X is zero.
    """
    q = factor.shape[0]
    X = np.zeros((q, q))
    out[:] = 0.0
    for start in range(0, q, PANEL):
        stop = min(start + PANEL, q)
        for i in range(start, stop):
            X[i, i] = 1.0
        rows = X[start:stop, :stop]
        subtract_product(factor[start:stop, :start], X[:start, :start], rows[:, :start])
        _solve_panel(factor, start, stop, X, stop)
        add_symmetric(rows.T, rows, out[:stop, :stop])
    finite = True
    for i in range(q):
        finite = finite and bool(np.isfinite(out[i, i]))
    return finite
