"""The inverse M⁻¹ of the information matrix in compiled code."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

contracted = numba.njit(cache=True, error_model="numpy", fastmath={"contract"})


@contracted  # type: ignore[untyped-decorator]
def absorb(covariance: Any, rows: Any, residuals: Any, scratch: Any) -> None:
    """Turn M⁻¹ into (M + JᵀJ)⁻¹ and the residuals e into L⁻¹e (Woodbury identity).

    With V = J M⁻¹ and the Cholesky factor L of I + V Jᵀ, the update is M⁻¹ - (L⁻¹V)ᵀ(L⁻¹V): it
    stays symmetric to the last bit.

    Parameters
    ----------
    covariance : (q, q)
        M⁻¹, overwritten.
    rows : (r, q)
        J.
    residuals : (r,)
        e, overwritten: then ``scratch.T @ residuals`` is the least-squares correction of θ.
    scratch : (r, q)
        Overwritten by L⁻¹V.
    """
    r, q = rows.shape
    np.dot(rows, covariance, scratch)
    gain = np.dot(scratch, rows.T)
    for k in range(r):
        gain[k, k] += 1.0
    L = np.linalg.cholesky(gain)
    for k in range(r):
        for i in range(k):
            factor = L[k, i]
            residuals[k] -= factor * residuals[i]
            for j in range(q):
                scratch[k, j] -= factor * scratch[i, j]
        residuals[k] /= L[k, k]
        for j in range(q):
            scratch[k, j] /= L[k, k]
    _subtract_products(covariance, scratch)


@contracted  # type: ignore[untyped-decorator]
def _subtract_products(covariance: Any, V: Any) -> None:
    """Subtract VᵀV in place, two rows of V at a time."""
    r, q = V.shape
    for k in range(0, r - 1, 2):
        first, second = V[k], V[k + 1]
        for i in range(q):
            row, a, b = covariance[i], first[i], second[i]
            for j in range(q):
                row[j] -= a * first[j] + b * second[j]
    if r % 2:
        last = V[r - 1]
        for i in range(q):
            row, a = covariance[i], last[i]
            for j in range(q):
                row[j] -= a * last[j]
