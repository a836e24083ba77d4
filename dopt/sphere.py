"""Quadratic maximisation on a sphere: max uᵀQu - 2vᵀu subject to ‖u‖ = γ (equation 7).

With Q = Z diag(ξ) Zᵀ, a point is a global maximum if and only if (Q - μI) u = v for a multiplier
μ ≥ ξ_max. In the eigenbasis ũ_i = -ṽ_i / (τ + δ_i), with ṽ = Zᵀv, the gaps δ_i = ξ_max - ξ_i ≥ 0
and τ = μ - ξ_max ≥ 0 the root of the secular equation ‖ũ(τ)‖ = γ. Newton's method on 1/‖ũ(τ)‖,
which is nearly linear, is kept inside a bracket. Working in τ and not in μ loses no digits when
the root lies close to the pole. Reference: J. Moré and D. Sorensen, "Computing a trust region
step", SIAM J. Sci. Stat. Comput. 4 (1983).

The compiled kernel compiles this very function: hence loops, which cost nothing there, in place of
array expressions.

======  =======================================  =====
symbol  meaning                                  shape
======  =======================================  =====
Q       symmetric matrix, of any definiteness    m × m
v       linear term                              m
γ       radius                                   1
======  =======================================  =====
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dopt.errors import DoptError

Array = npt.NDArray[np.float64]

NEWTON_STEPS = 60
TINY = 1e-150
ROUNDING = 4e-16


def maximize_on_sphere(Q: Array, v: Array, radius: float, tie: Array) -> Array:
    """Return a global maximiser of uᵀQu - 2vᵀu on ‖u‖ = radius.

    Parameters
    ----------
    Q : (m, m)
        Quadratic term; its symmetric part counts.
    v : (m,)
        Linear term.
    radius : float
        γ > 0. γ|Q| may overflow or underflow.
    tie : (m,)
        Any vector, normally random: decides between maximisers of equal value.

    Returns
    -------
    (m,)
        The input u.

    Raises
    ------
    DoptError
        If Q or v is not finite.
    """
    if not (np.all(np.isfinite(Q)) and np.all(np.isfinite(v))):
        raise DoptError(
            "the quadratic problem on the sphere has entries that are not finite, finite ones are "
            "expected: the model or the information matrix has diverged."
        )
    with np.errstate(over="ignore", under="ignore"):
        return sphere_maximizer(np.asarray(Q, float), np.asarray(v, float), radius, np.asarray(tie))


def sphere_maximizer(Q: Array, v: Array, radius: float, tie: Array) -> Array:
    """Return the maximiser (see :func:`maximize_on_sphere`); NaN where Q is not finite."""
    m = v.shape[0]
    largest = _largest(Q)
    if not np.isfinite(largest):
        return np.full(m, np.nan)
    divisor, scale = 1.0, _scale(Q, v, radius, 1.0)
    if largest > 0.0 and not 0.0 < scale < np.inf:
        # γ|Q| is no number of double precision: the objective is divided by |Q|.
        divisor, scale = largest, _scale(Q, v, radius, largest)
    if scale == 0.0:
        return _with_norm(tie.copy(), radius)
    A = np.empty((m, m))
    for i in range(m):
        for j in range(m):
            # Divided one by one: the inverse of a denormal scale is infinite.
            A[i, j] = 0.5 * radius * (Q[i, j] / divisor / scale + Q[j, i] / divisor / scale)
    values, axes = np.linalg.eigh(A)
    rotated, preferred, gaps = np.zeros(m), np.zeros(m), np.zeros(m)
    largest = max(abs(values[0]), abs(values[m - 1]))
    top = 0.0
    for i in range(m):
        for j in range(m):
            rotated[i] += axes[j, i] * (v[j] / divisor / scale)
            preferred[i] += axes[j, i] * tie[j]
        # Eigenvalues that differ from the largest by rounding errors only count as equal to it.
        gaps[i] = values[m - 1] - values[i]
        if gaps[i] <= ROUNDING * m * largest:
            gaps[i] = 0.0
            top += rotated[i] * rotated[i]
    if np.sqrt(top) > TINY:
        unit = _easy_case(rotated, gaps, np.sqrt(top))
    else:
        unit = _hard_case(rotated, gaps, preferred)
    u = np.zeros(m)
    for i in range(m):
        for j in range(m):
            u[i] += axes[i, j] * unit[j]
    return _with_norm(u, radius)


def _scale(Q: Array, v: Array, radius: float, divisor: float) -> float:
    """Return the largest of |v| and γ|Q| in multiples of ``divisor``."""
    scale = 0.0
    for i in range(v.shape[0]):
        scale = max(scale, abs(v[i]) / divisor)
        for j in range(v.shape[0]):
            scale = max(scale, radius * (abs(Q[i, j]) / divisor))
    return scale


def _largest(Q: Array) -> float:
    """Return the largest |Q|, NaN if an entry is NaN."""
    largest = 0.0
    for i in range(Q.shape[0]):
        for j in range(Q.shape[1]):
            if np.isnan(Q[i, j]):
                return np.nan
            largest = max(largest, abs(Q[i, j]))
    return largest


def _easy_case(rotated: Array, gaps: Array, top: float) -> Array:
    """Return the unit vector -ṽ/(δ + τ), with τ the root of the secular equation.

    ``rotated`` is ṽ and ``gaps`` δ. The root lies between ``top``, the norm of ṽ in the eigenspace
    of the largest eigenvalue, and ‖ṽ‖.
    """
    low, high = top, _norm(rotated)
    tau = low
    u = np.empty_like(rotated)
    for _ in range(NEWTON_STEPS):
        curvature = 0.0
        for i in range(rotated.shape[0]):
            u[i] = -rotated[i] / (gaps[i] + tau)
            curvature += u[i] * u[i] / (gaps[i] + tau)
        norm = _norm(u)
        if norm >= 1.0:
            low = tau
        else:
            high = tau
        step = (norm - 1.0) * norm * norm / curvature
        if abs(step) <= ROUNDING * tau or high <= low:
            break
        tau = tau + step
        if not low < tau < high:
            tau = 0.5 * (low + high)
    return u


def _hard_case(rotated: Array, gaps: Array, preferred: Array) -> Array:
    """Return the unit maximiser where ṽ has no part in the top eigenspace.

    Either the root τ is positive all the same, or τ = 0 and the missing length goes along the top
    eigenspace, in the direction of ``preferred``.
    """
    m = rotated.shape[0]
    inside, u, along = np.zeros(m), np.zeros(m), np.zeros(m)
    for i in range(m):
        if gaps[i] > 0.0:
            inside[i] = rotated[i]
            u[i] = -rotated[i] / gaps[i]
        else:
            along[i] = preferred[i]
    norm = _norm(u)
    if norm > 1.0:
        return _easy_case(inside, gaps, TINY)
    length = _norm(along)
    if length <= TINY:
        along[m - 1] = 1.0
        length = 1.0
    for i in range(m):
        u[i] += along[i] * (np.sqrt(1.0 - norm * norm) / length)
    return u


def _norm(u: Array) -> float:
    total = 0.0
    for i in range(u.shape[0]):
        total += u[i] * u[i]
    return float(np.sqrt(total))


def _with_norm(u: Array, radius: float) -> Array:
    """Return ``u``, overwritten, with a norm; along the first axis if it is zero."""
    length = _norm(u)
    if length == 0.0:
        u[0] = 1.0
        length = 1.0
    for i in range(u.shape[0]):
        u[i] *= radius / length
    return u
