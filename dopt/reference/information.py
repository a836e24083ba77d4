"""Information matrix of a batch of trials, held as what solves systems of equations with it.

======  ==================================================  =========
symbol  meaning                                             shape
======  ==================================================  =========
M       information matrix, of s dimensions                 n × s × s
L       Cholesky factor of M when it was last factorised    n × s × s
P       inverse of that M, in the place of L                n × s × s
U       roots of what was added since: M⁻¹ = P - U Uᵀ       n × s × k
J       rows that were added and wait: M grows by JᵀJ       n × r × s
======  ==================================================  =========

A small M is factorised afresh. Of a large one a step reads P once: the columns that are solved for
and the rows that wait go through it together. It is written only after many rows.
"""

from __future__ import annotations

import torch
from torch import Tensor

MOST_ROOTS = 16
"""Columns of U after which they are subtracted from P."""

SMALL = 100
"""Largest size of an M that is factorised afresh after each step."""


class BatchInformation:
    """M of n trials, which grows by rows.

    A trial for which rounding has left M indefinite has NaN in its solutions.

    Parameters
    ----------
    matrix : (n, s, s) tensor
        M at the beginning.
    """

    def __init__(self, matrix: Tensor) -> None:
        self.replace(matrix)
        if matrix.shape[1] > SMALL:
            self._subtract_roots()  # rows come next: products with P take less than with L

    @property
    def size(self) -> int:
        """Number of dimensions s."""
        return len(self._roots[0])

    def replace(self, matrix: Tensor) -> None:
        """Hold another M, (n, s, s), whatever was there before."""
        self._matrix = matrix if matrix.shape[1] <= SMALL else None
        self._factor: Tensor | None = cholesky_factor(matrix)
        self._inverse: Tensor | None = None
        self._roots = matrix.new_zeros(*matrix.shape[:2], 0)
        self._waiting = matrix.new_zeros(len(matrix), 0, matrix.shape[1])

    def add(self, rows: Tensor) -> None:
        """Add JᵀJ for rows (n, r, s)."""
        self._waiting = torch.cat([self._waiting, rows], dim=1)

    def scale(self, factor: float) -> None:
        """Multiply M by a positive number."""
        if factor != 1.0 and self._matrix is not None:
            self.replace(factor * self.matrix())
        elif factor != 1.0:
            self._inverse = self.covariance() / factor

    def solve(self, columns: Tensor) -> Tensor:
        """Return M⁻¹ C, (n, s, c), for columns C (n, s, c)."""
        waiting = self._waiting
        r = waiting.shape[1]
        if r and self._matrix is not None:
            self.replace(self._matrix + waiting.mT @ waiting)
        if r == 0 or self._matrix is not None:
            return self._solved(columns)
        both = self._solved(torch.cat([waiting.mT, columns], dim=2))
        along, solved = both[..., :r], both[..., r:]
        identity = torch.eye(r, dtype=columns.dtype, device=columns.device)
        factor = cholesky_factor(identity + waiting @ along)
        roots = torch.linalg.solve_triangular(factor, along.mT, upper=False).mT
        self._roots = torch.cat([self._roots, roots], dim=2)
        self._waiting = waiting[:, :0]
        if self._roots.shape[2] > MOST_ROOTS:
            self._subtract_roots()
        return torch.baddbmm(solved, roots, roots.mT @ columns, alpha=-1)

    def covariance(self) -> Tensor:
        """Return M⁻¹, (n, s, s), which the next rows change in place."""
        self.solve(self._waiting.mT[..., :0])
        return self._subtract_roots()

    def upper_root(self) -> Tensor:
        """Return the upper triangular U of M⁻¹ = U Uᵀ, (n, s, s)."""
        return cholesky_factor(self.covariance().flip(1, 2)).flip(1, 2)

    def matrix(self) -> Tensor:
        """Return M, (n, s, s); a large one as the inverse of M⁻¹."""
        covariance = self.covariance()
        if self._matrix is not None:
            return self._matrix
        return torch.cholesky_inverse(cholesky_factor(covariance))

    def _solved(self, columns: Tensor) -> Tensor:
        """Return (P - U Uᵀ) C for columns (n, s, c)."""
        if self._factor is not None:
            solved = torch.cholesky_solve(columns, self._factor)
        else:
            assert self._inverse is not None
            solved = self._inverse @ columns
        if self._roots.shape[2]:
            solved = torch.baddbmm(solved, self._roots, self._roots.mT @ columns, alpha=-1)
        return solved

    def _subtract_roots(self) -> Tensor:
        """Make P = M⁻¹ of all rows that do not wait; return it."""
        if self._inverse is None:
            assert self._factor is not None
            self._inverse, self._factor = torch.cholesky_inverse(self._factor), None
        if self._roots.shape[2]:
            torch.baddbmm(self._inverse, self._roots, self._roots.mT, alpha=-1, out=self._inverse)
            self._roots = self._roots[..., :0]
        return self._inverse


def cholesky_factor(matrix: Tensor) -> Tensor:
    """Return the lower Cholesky factors of matrices, (n, s, s); NaN where one is indefinite."""
    factor, failed = torch.linalg.cholesky_ex(matrix)
    return torch.where((failed > 0)[:, None, None], torch.nan, factor)
