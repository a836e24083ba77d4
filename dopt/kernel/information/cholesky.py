"""Cholesky factor of a positive definite matrix, its inverse and solutions, in compiled code."""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled, vectorized
from dopt.kernel.information.primal import add_multiple, inner
from dopt.types import Matrix, Stack, Vector

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
    """Replace the first entries of each right-hand side, (k, ·), by those of C⁻¹ times it."""
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
