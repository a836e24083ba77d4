"""Quadratic maximisation on a sphere: max uᵀQu - 2vᵀu subject to ‖u‖ = γ (equation 7).

With Q = V diag(λ) Vᵀ, a point is a global maximum if and only if (Q - μI) u = v for a multiplier
μ ≥ λ_max. In the eigenbasis u_i = -w_i / (s + g_i), with w = Vᵀv, the gaps g_i = λ_max - λ_i ≥ 0
and s = μ - λ_max ≥ 0 the root of the secular equation ‖u(s)‖ = γ. Newton's method on 1/‖u(s)‖,
which is nearly linear, is kept inside a bracket. Working in s and not in μ loses no digits when
the root lies close to the pole. Reference: J. Moré and D. Sorensen, "Computing a trust region
step", SIAM J. Sci. Stat. Comput. 4 (1983).

The code is plain NumPy and the compiled kernel compiles this very function.

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
        γ > 0.
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
    return sphere_maximizer(np.asarray(Q, float), np.asarray(v, float), radius, np.asarray(tie))


def sphere_maximizer(Q: Array, v: Array, radius: float, tie: Array) -> Array:
    """Return the maximiser for finite arguments (see :func:`maximize_on_sphere`)."""
    m = v.shape[0]
    scale = max(radius * np.max(np.abs(Q)), np.max(np.abs(v)))
    if scale == 0.0:
        return _with_norm(tie, radius)
    values, axes = np.linalg.eigh((Q + Q.T) * (0.5 * radius / scale))
    w = np.dot(np.ascontiguousarray(axes.T), v / scale)
    gaps = values[m - 1] - values
    # Eigenvalues that differ by rounding alone are one: their directions must not be told apart.
    for i in range(m):
        if gaps[i] <= ROUNDING * m * max(abs(values[0]), abs(values[m - 1])):
            gaps[i] = 0.0
    top = 0.0
    for i in range(m):
        if gaps[i] == 0.0:
            top += w[i] * w[i]
    top = np.sqrt(top)
    unit = _easy_case(w, gaps, top) if top > TINY else _hard_case(w, gaps, axes, tie)
    return _with_norm(np.dot(axes, unit), radius)


def _easy_case(w: Array, gaps: Array, top: float) -> Array:
    """Solve the secular equation for a unit vector; ``top`` = norm of w in the top eigenspace."""
    low, high = top, np.sqrt(np.sum(w * w))
    s = low
    for _ in range(NEWTON_STEPS):
        u = w / (gaps + s)
        norm = np.sqrt(np.sum(u * u))
        if norm >= 1.0:
            low = s
        else:
            high = s
        step = (norm - 1.0) * norm * norm / np.sum(u * u / (gaps + s))
        if abs(step) <= ROUNDING * s or high <= low:
            break
        s = s + step
        if not low < s < high:
            s = 0.5 * (low + high)
    return -w / (gaps + s)


def _hard_case(w: Array, gaps: Array, axes: Array, tie: Array) -> Array:
    """Solve where v has no part in the top eigenspace.

    Either the root s is positive all the same, or s = 0 and the missing length goes along the top
    eigenspace, in the direction of ``tie``.
    """
    below = np.where(gaps > 0.0, gaps, 1.0)
    inside = np.where(gaps > 0.0, w, 0.0)
    u = -inside / below
    norm = np.sqrt(np.sum(u * u))
    if norm > 1.0:
        return _easy_case(inside, gaps, TINY)
    preferred = np.dot(np.ascontiguousarray(axes.T), tie)
    preferred = np.where(gaps > 0.0, 0.0, preferred)
    length = np.sqrt(np.sum(preferred * preferred))
    if length <= TINY:
        preferred[preferred.shape[0] - 1] = 1.0
        length = 1.0
    return u + preferred * (np.sqrt(1.0 - norm * norm) / length)


def _with_norm(u: Array, radius: float) -> Array:
    """Return ``u`` scaled to a norm; the first axis if it is zero."""
    length = np.sqrt(np.sum(u * u))
    if length == 0.0:
        u = np.zeros_like(u)
        u[0] = 1.0
        length = 1.0
    return u * (radius / length)
