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

U has room for more columns than it holds; the others are 0, so that all steps take the same shapes.

A small M is factorised afresh. Of a large one a step reads P once: the columns that are solved for
and the rows that wait go through it together. It is written only after many rows.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
from torch import Tensor

from dopt.reference.recorded import Recorded

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
        self._solve_with_rows = Recorded(solve_with_rows, in_place=2)
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
        self._roots, self._n_roots = matrix.new_zeros(*matrix.shape[:2], 0), 0
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
        """Return M⁻¹ C, (n, s, c), for columns C (n, s, c); the next call may overwrite it."""
        waiting = self._waiting
        r = waiting.shape[1]
        if r and self._matrix is not None:
            self.replace(self._matrix + waiting.mT @ waiting)
        if r == 0 or self._matrix is not None:
            return self._solved(columns)
        if self._factor is not None:
            solved, roots = with_rows(self._solved, waiting, columns)
        else:
            assert self._inverse is not None
            held = self._inverse, self._roots
            solved, roots = self._solve_with_rows(*held, waiting, columns)
        self._keep(roots)
        self._waiting = waiting[:, :0]
        return solved

    def _keep(self, roots: Tensor) -> None:
        """Write columns into U; many of them are subtracted from P."""
        r = roots.shape[2]
        if self._n_roots + r > self._roots.shape[2]:
            if self._n_roots:
                self._subtract_roots()
            self._roots = roots.new_zeros(*roots.shape[:2], MOST_ROOTS + r)
        self._roots[..., self._n_roots : self._n_roots + r] = roots
        self._n_roots += r
        if self._n_roots > MOST_ROOTS:
            self._subtract_roots()

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
        roots = self._roots[..., : self._n_roots]
        if self._factor is None:
            assert self._inverse is not None
            return solve(self._inverse, roots, columns)
        solved = torch.cholesky_solve(columns, self._factor)
        return torch.baddbmm(solved, roots, roots.mT @ columns, alpha=-1)

    def _subtract_roots(self) -> Tensor:
        """Make P = M⁻¹ of all rows that do not wait; return it."""
        if self._inverse is None:
            assert self._factor is not None
            self._inverse, self._factor = torch.cholesky_inverse(self._factor), None
        if self._n_roots:
            torch.baddbmm(self._inverse, self._roots, self._roots.mT, alpha=-1, out=self._inverse)
            self._roots.zero_()
            self._n_roots = 0
        return self._inverse


def solve(inverse: Tensor, roots: Tensor, columns: Tensor) -> Tensor:
    """Return (P - U Uᵀ) C, (n, s, c), for P (n, s, s), U (n, s, k) and columns C (n, s, c)."""
    return torch.baddbmm(inverse @ columns, roots, roots.mT @ columns, alpha=-1)


def with_rows(
    solved: Callable[[Tensor], Tensor], rows: Tensor, columns: Tensor
) -> tuple[Tensor, Tensor]:
    """Return (M + JᵀJ)⁻¹ C, and R (n, s, r) of (M + JᵀJ)⁻¹ = M⁻¹ - R Rᵀ, for J (n, r, s).

    ``solved`` takes columns (n, s, ·) to M⁻¹ times them, and is called once.
    """
    r = rows.shape[1]
    both = solved(torch.cat([rows.mT, columns], dim=2))
    along, straight = both[..., :r], both[..., r:]
    identity = torch.eye(r, dtype=columns.dtype, device=columns.device)
    factor = cholesky_factor(identity + rows @ along)
    roots = torch.linalg.solve_triangular(factor, along.mT, upper=False).mT
    return torch.baddbmm(straight, roots, roots.mT @ columns, alpha=-1), roots


def solve_with_rows(
    inverse: Tensor, roots: Tensor, rows: Tensor, columns: Tensor
) -> tuple[Tensor, Tensor]:
    """Return what :func:`with_rows` does, for M⁻¹ = P - U Uᵀ."""
    return with_rows(functools.partial(solve, inverse, roots), rows, columns)


def cholesky_factor(matrix: Tensor) -> Tensor:
    """Return the lower Cholesky factors of matrices, (n, s, s); NaN where one is indefinite."""
    factor, failed = torch.linalg.cholesky_ex(matrix)
    return torch.where((failed > 0)[:, None, None], torch.nan, factor)
