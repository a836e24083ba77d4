"""The inverse M⁻¹ of the information matrix in compiled code.

Only the upper triangle is stored and read: half the memory traffic, and symmetric by construction.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dopt.kernel.compiler import vectorized


@vectorized
def symmetric_product(upper: Any, x: Any, y: Any) -> None:
    """Write y = A x, (q,), for a symmetric A given by its upper triangle, (q, q)."""
    y[:] = 0.0
    for i in range(x.shape[0]):
        total = _dot_and_add(upper[i, i + 1 :], x[i + 1 :], x[i], y[i + 1 :])
        y[i] += total + upper[i, i] * x[i]


@vectorized
def _dot_and_add(row: Any, x: Any, factor: float, y: Any) -> float:
    """Return rowᵀx and add ``factor`` times the row to y."""
    total = 0.0
    for j in range(row.shape[0]):
        total += row[j] * x[j]
        y[j] += row[j] * factor
    return total


@vectorized
def symmetric_products(upper: Any, x_1: Any, x_2: Any, y_1: Any, y_2: Any) -> None:
    """Write y₁ = A x₁ and y₂ = A x₂ in one pass over the upper triangle of A."""
    y_1[:] = 0.0
    y_2[:] = 0.0
    for i in range(x_1.shape[0]):
        total_1, total_2 = _dots_and_adds(
            upper[i, i + 1 :],
            x_1[i + 1 :],
            x_2[i + 1 :],
            x_1[i],
            x_2[i],
            y_1[i + 1 :],
            y_2[i + 1 :],
        )
        y_1[i] += total_1 + upper[i, i] * x_1[i]
        y_2[i] += total_2 + upper[i, i] * x_2[i]


@vectorized
def _dots_and_adds(
    row: Any, x_1: Any, x_2: Any, factor_1: float, factor_2: float, y_1: Any, y_2: Any
) -> Any:
    total_1, total_2 = 0.0, 0.0
    for j in range(row.shape[0]):
        entry = row[j]
        total_1 += entry * x_1[j]
        total_2 += entry * x_2[j]
        y_1[j] += entry * factor_1
        y_2[j] += entry * factor_2
    return total_1, total_2


@vectorized
def multiply_rows(upper: Any, rows: Any, out: Any) -> None:
    """Write the products of A with each row of ``rows``, (k, q), two at a time."""
    k = rows.shape[0]
    for i in range(0, k - 1, 2):
        symmetric_products(upper, rows[i], rows[i + 1], out[i], out[i + 1])
    if k % 2:
        symmetric_product(upper, rows[k - 1], out[k - 1])


@vectorized
def inner(a: Any, b: Any) -> float:
    """Return aᵀb."""
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@vectorized
def quadratic_forms(upper: Any, left: Any, right: Any) -> Any:
    """Return left A rightᵀ for ``left`` (k, q) and ``right`` (n, q)."""
    products = np.empty(left.shape)
    multiply_rows(upper, left, products)
    out = np.empty((left.shape[0], right.shape[0]))
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = inner(products[i], right[j])
    return out


@vectorized
def absorb(upper: Any, rows: Any, residuals: Any, scratch: Any) -> None:
    """Turn M⁻¹ into (M + JᵀJ)⁻¹ and the residuals e into L⁻¹e (Woodbury identity).

    With V = J M⁻¹ and the Cholesky factor L of I + V Jᵀ, the update is M⁻¹ - (L⁻¹V)ᵀ(L⁻¹V).

    Parameters
    ----------
    upper : (q, q)
        M⁻¹, its upper triangle overwritten.
    rows : (r, q)
        J.
    residuals : (r,)
        e, overwritten: then ``scratch.T @ residuals`` is the least-squares correction of θ.
    scratch : (r, q)
        Overwritten by L⁻¹V.
    """
    r, q = rows.shape
    multiply_rows(upper, rows, scratch)
    L = np.zeros((r, r))
    for k in range(r):
        for i in range(k + 1):
            L[k, i] = inner(scratch[k], rows[i]) + (1.0 if i == k else 0.0)
    _factorize(L)
    for k in range(r):
        for i in range(k):
            residuals[k] -= L[k, i] * residuals[i]
            for j in range(q):
                scratch[k, j] -= L[k, i] * scratch[i, j]
        residuals[k] /= L[k, k]
        for j in range(q):
            scratch[k, j] /= L[k, k]
    _subtract_products(upper, scratch)


@vectorized
def _factorize(L: Any) -> None:
    """Replace the lower triangle of a positive definite matrix, (r, r), by its Cholesky factor."""
    for k in range(L.shape[0]):
        for i in range(k + 1):
            value = L[k, i]
            for j in range(i):
                value -= L[k, j] * L[i, j]
            L[k, i] = np.sqrt(value) if i == k else value / L[i, i]


@vectorized
def _subtract_products(upper: Any, V: Any) -> None:
    """Subtract VᵀV from the upper triangle, two rows of V in one pass."""
    r, q = V.shape
    for k in range(0, r - 1, 2):
        for i in range(q):
            _subtract_two(upper[i, i:], V[k, i], V[k, i:], V[k + 1, i], V[k + 1, i:])
    if r % 2:
        for i in range(q):
            _subtract_one(upper[i, i:], V[r - 1, i], V[r - 1, i:])


@vectorized
def _subtract_two(row: Any, a: float, first: Any, b: float, second: Any) -> None:
    for j in range(row.shape[0]):
        row[j] -= a * first[j] + b * second[j]


@vectorized
def _subtract_one(row: Any, a: float, values: Any) -> None:
    for j in range(row.shape[0]):
        row[j] -= a * values[j]
