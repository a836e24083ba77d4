"""The largest eigenvalue of M⁻¹ in a block Krylov space, in compiled code."""

from __future__ import annotations

import numpy as np

from dopt.algorithm import INVARIANT
from dopt.kernel.compiler import compiled
from dopt.kernel.information.primal import add_multiple, inner, multiply_rows
from dopt.kernel.state_structs import Covariance
from dopt.types import Matrix


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
    return basis, np.dot(basis, images.T)


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
    W, K = np.dot(removed, basis.T), projected.shape[0]
    left = projected.copy()
    for k in range(W.shape[0]):
        for i in range(K):
            add_multiple(left[i], -W[k, i], W[k])
    largest: float = np.linalg.eigvalsh(left)[K - 1]
    return largest
