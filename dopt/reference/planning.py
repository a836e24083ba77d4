"""Equations (5) to (7) for a batch of trials: the information matrix M and the inputs it asks for.

======  ==================================================  =========
symbol  meaning (Proposition 1)                             shape
======  ==================================================  =========
x̄       predicted state x_t + dt f_θ(x_t, 0)                d
B       dt ∂known/∂u at x̄                                   d × m
g       ∂a_θ^k/∂θ at x̄                                      q
D B     derivative of g along the columns of B              q × m
M       information matrix                                  q × q
J       rows that a sample adds: M grows by JᵀJ             r × q
======  ==================================================  =========

The maximum on the sphere is found as in :mod:`dopt.sphere`, in another form: the root of the
secular equation is enclosed for all problems at once, in intervals of which each is a part of the
one before.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dopt.algorithm import TIE_MARGIN
from dopt.reference.models import BatchModel, gradients_and_changes, input_matrix, model_states
from dopt.systems.base import System

SMALL = 100
"""Largest size of an M that is factorised afresh after each step; of a larger one M⁻¹ is held."""

PARTS = 64
DIVISIONS = 11
TINY = 1e-150
ROUNDING = 4e-16


class BatchInformation:
    """M of n trials, (n, s, s), λI at the beginning, which grows by rows.

    A trial for which rounding has left M indefinite has NaN in its solutions.
    """

    def __init__(self, regularization: float, like: Tensor) -> None:
        n, s = like.shape
        self._is_small, identity = s <= SMALL, torch.eye(s).to(like).repeat(n, 1, 1)
        self._held = identity * (regularization if self._is_small else 1.0 / regularization)

    def add(self, J: Tensor) -> None:
        """Add JᵀJ for rows (n, r, s)."""
        if self._is_small:
            self._held = self._held + J.mT @ J
            return
        along = self._held @ J.mT
        factor = cholesky_factor(torch.eye(J.shape[1]).to(J) + J @ along)
        roots = torch.linalg.solve_triangular(factor, along.mT, upper=False)
        self._held = torch.baddbmm(self._held, roots.mT, roots, alpha=-1)

    def solve(self, columns: Tensor) -> Tensor:
        """Return M⁻¹ C, (n, s, c), for columns C (n, s, c)."""
        if not self._is_small:
            return self._held @ columns
        return torch.cholesky_solve(columns, cholesky_factor(self._held))


def cholesky_factor(matrix: Tensor) -> Tensor:
    """Return the lower Cholesky factors of matrices, (n, s, s); NaN where one is indefinite."""
    factor, failed = torch.linalg.cholesky_ex(matrix)
    return torch.where((failed > 0)[:, None, None], torch.nan, factor)


class QuadraticProblem(NamedTuple):
    """Equation 7 for a batch of n trials: maximise uᵀQu - 2vᵀu on the sphere."""

    Q: Tensor  # (n, m, m)
    v: Tensor  # (n, m)


def predicted_states(system: System, model: BatchModel, theta: Tensor, x: Tensor) -> Tensor:
    """Return x̄ of every trial, (n, d), for parameters (n, q) and states (n, d)."""
    zero = torch.zeros(len(x), system.n_inputs, dtype=x.dtype, device=x.device)
    return model_states(system, model, theta, x, zero, system.dt)


def planning_columns(
    system: System, model: BatchModel, theta: Tensor, x: Tensor, components: Tensor
) -> Tensor:
    """Return g and the columns of D B as rows, (n, 1 + m, q), for components (n,)."""
    bar = predicted_states(system, model, theta, x)
    B = input_matrix(system, bar)
    n, m = len(x), B.shape[2]
    g, DB = gradients_and_changes(
        model,
        theta.repeat_interleave(m, dim=0),
        bar.repeat_interleave(m, dim=0),
        components.repeat_interleave(m, dim=0),
        B.mT.flatten(0, 1),
    )
    return torch.cat([g.view(n, m, -1)[:, :1], DB.view(n, m, -1)], dim=1)


def quadratic_problem(columns: Tensor, information: BatchInformation) -> QuadraticProblem:
    """Return Q and v from the :func:`planning_columns`, (n, 1 + m, s)."""
    forms = columns @ information.solve(columns.mT)
    return QuadraticProblem(forms[:, 1:, 1:], -forms[:, 1:, 0])


def d_optimal_inputs(problem: QuadraticProblem, gamma: float, ties: Tensor) -> Tensor:
    """Return the maximisers, (n, m); ``ties`` (n, m) decide between equal ones.

    A problem that is not finite has none: its input is NaN, and the trial diverges.
    """
    Q, v = problem
    finite = torch.cat([Q, v.unsqueeze(-1)], dim=-1).isfinite().all(-1).all(-1, keepdim=True)
    if v.shape[1] == 1:
        up = (v < 0) | ((v == 0) & (ties > 0))
        chosen = torch.where(up, gamma, -gamma).to(v)
    else:
        Q, v = torch.where(finite.unsqueeze(-1), Q, 0.0), torch.where(finite, v, 0.0)
        chosen = maximize_on_spheres(Q, v, gamma, ties)
    return torch.where(finite, chosen, torch.nan)


def uniform_inputs(
    system: System, model: BatchModel, theta: Tensor, states: Tensor, steps: int
) -> Tensor:
    """Return the inputs, (n, m), that lead farthest from all states seen, (n, t + 1, d).

    Gradient ascent on the sphere from ±γ along every input axis, by automatic differentiation.
    """
    x = states[:, -1]
    center = predicted_states(system, model, theta, x).unsqueeze(1)
    B = input_matrix(system, x)
    axes = torch.eye(system.n_inputs, dtype=x.dtype, device=x.device)
    starts = system.gamma * torch.stack([axes, -axes], dim=1).flatten(0, 1)

    def distances(u: Tensor) -> Tensor:
        reached = (center + u @ B.mT).unsqueeze(2)
        apart: Tensor = torch.linalg.vector_norm(reached - states.unsqueeze(1), dim=-1)
        return apart.sum(dim=-1)

    u = starts.expand(len(x), -1, -1)
    for _ in range(steps if system.n_inputs > 1 else 0):
        with torch.enable_grad():
            u = u.detach().requires_grad_()
            (slope,) = torch.autograd.grad(distances(u).sum(), u)
        u = system.gamma * slope / torch.linalg.vector_norm(slope, dim=-1, keepdim=True)
    value = distances(u)
    best, best_value = u[:, 0], value[:, 0]
    for i in range(1, len(starts)):
        better = value[:, i] > best_value * (1 + TIE_MARGIN)
        best = torch.where(better.unsqueeze(-1), u[:, i], best)
        best_value = torch.where(better, value[:, i], best_value)
    return best


def maximize_on_spheres(Q: Tensor, v: Tensor, radius: float, ties: Tensor) -> Tensor:
    """Return maximisers, (n, m), of uᵀQu - 2vᵀu on ‖u‖ = radius.

    Parameters
    ----------
    Q : (n, m, m)
        Quadratic terms; the symmetric parts count.
    v : (n, m)
        Linear terms.
    radius : float
        γ > 0.
    ties : (n, m)
        Directions that decide between maximisers of equal value.
    """
    Q, v = _without_overflow(Q, v)
    scale = torch.maximum(radius * Q.abs().amax((1, 2)), v.abs().amax(1))
    flat, scale = (scale == 0)[:, None], scale.clamp_min(1e-300)
    A = (Q + Q.mT) * (0.5 * radius / scale)[:, None, None]
    values, axes = torch.linalg.eigh(A)
    w = (axes.mT @ (v / scale[:, None]).unsqueeze(-1)).squeeze(-1)
    preferred = (axes.mT @ ties.unsqueeze(-1)).squeeze(-1)
    gaps = values[:, -1:] - values
    top = gaps <= ROUNDING * values.shape[1] * values.abs().amax(1, keepdim=True)
    gaps = torch.where(top, torch.zeros_like(gaps), gaps)

    s = _secular_root(w, gaps, top)
    unit = -w / (gaps + s).clamp_min(1e-300)
    below = torch.where(top, torch.zeros_like(w), -w / torch.where(top, torch.ones_like(w), gaps))
    missing = 1 - below.square().sum(1, keepdim=True)
    along = torch.where(top, preferred, torch.zeros_like(preferred))
    along = _direction(along, axis=-1)
    hard = (torch.where(top, w, torch.zeros_like(w)).abs().amax(1, keepdim=True) < TINY) & (
        missing >= 0
    )
    unit = torch.where(hard, below + along * missing.clamp_min(0).sqrt(), unit)
    u = (axes @ unit.unsqueeze(-1)).squeeze(-1)
    u = torch.where(flat, _direction(ties, axis=0), u)
    scaled: Tensor = u * (radius / torch.linalg.vector_norm(u, dim=1, keepdim=True))
    return scaled


def _without_overflow(Q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Return both divided by a power of two, which is exact: the largest entry is 1 to 2."""
    largest = torch.maximum(Q.abs().amax((1, 2)), v.abs().amax(1))
    unit = torch.ldexp(torch.ones_like(largest), torch.frexp(largest).exponent - 1)
    unit = torch.where(largest > 0, unit, torch.ones_like(unit))
    return Q / unit[:, None, None], v / unit[:, None]


def _direction(vectors: Tensor, axis: int) -> Tensor:
    """Return vectors, (n, m), of norm 1; along an axis where they are zero."""
    length = torch.linalg.vector_norm(vectors, dim=1, keepdim=True)
    along_axis = torch.zeros_like(vectors)
    along_axis[:, axis] = 1.0
    return torch.where(length > TINY, vectors / length.clamp_min(TINY), along_axis)


def _secular_root(w: Tensor, gaps: Tensor, top: Tensor) -> Tensor:
    """Return s ≥ 0 with ‖w / (gaps + s)‖ = 1, (n, 1), by division of its logarithm's range."""
    low = torch.where(top, w, torch.zeros_like(w)).square().sum(1, keepdim=True).sqrt()
    low = low.clamp_min(TINY).log()
    high = torch.linalg.vector_norm(w, dim=1, keepdim=True).clamp_min(TINY).log()
    high = torch.maximum(low, high)
    shares = torch.linspace(0.0, 1.0, PARTS + 1).to(w)
    for _ in range(DIVISIONS):
        tried = low + (high - low) * shares
        squares = (w.unsqueeze(2) / (gaps.unsqueeze(2) + tried.exp().unsqueeze(1))).square()
        outside = (squares.sum(1) >= 1).sum(1, keepdim=True)
        part = (outside - 1).clamp(0, PARTS - 1)
        low, high = tried.gather(1, part), tried.gather(1, part + 1)
    return (0.5 * (low + high)).exp()
