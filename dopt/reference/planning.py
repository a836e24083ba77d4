"""Closed-loop plans by automatic differentiation, for a batch of trials.

======  ==================================================  =========
symbol  meaning (Proposition 1)                             shape
======  ==================================================  =========
x̄       predicted state x_t + dt f_θ(x_t, 0)                d
B       dt ∂f_θ/∂u at x̄                                     d × m
g       ∂a_θ^k/∂θ at x̄                                      q
D B     derivative of g along the columns of B              q × m
M       information matrix                                  q × q
======  ==================================================  =========
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from dopt.algorithm import TIE_MARGIN
from dopt.reference.derivatives import gradients_and_changes
from dopt.reference.dynamics import LearnedDynamics
from dopt.reference.sphere import maximize_on_spheres


class QuadraticProblem(NamedTuple):
    """Equation 7 for a batch of n trials: maximise uᵀQu - 2vᵀu on the sphere."""

    Q: Tensor  # (n, m, m)
    v: Tensor  # (n, m)


def predicted_states(learned: LearnedDynamics, theta: Tensor, x: Tensor) -> Tensor:
    """Return x̄ of every trial, (n, d), for parameters (n, q) and states (n, d)."""
    system = learned.system
    zero = torch.zeros(len(x), system.n_inputs, dtype=x.dtype, device=x.device)
    return learned.next_states(theta, x, zero, system.dt)


def planning_columns(
    learned: LearnedDynamics,
    project: Callable[[Tensor], Tensor],
    theta: Tensor,
    x: Tensor,
    components: Tensor,
    next_inputs: Tensor,
) -> Tensor:
    """Return g and the columns of D B in the space of M, (n, c, 1 + m, s), for components (n, c).

    Given are parameters (n, q) and states (n, d). ``next_inputs`` (n, m) are those of the next
    sample, for a model that reads inputs. ``project`` maps gradients, (..., q), to the space of M,
    (..., s): the identity, or a sketch.
    """
    g, DB = gradient_and_changes(learned, theta, x, components, next_inputs)
    return project(torch.cat([g.unsqueeze(2), DB], dim=2))


def drawn_columns(
    learned: LearnedDynamics,
    project: Callable[[Tensor], Tensor],
    theta: Tensor,
    x: Tensor,
    components: Tensor,
    directions: Tensor,
    shares: Tensor,
) -> Tensor:
    """Return :func:`planning_columns` for next inputs of drawn directions, (n, m).

    Their norms are drawn shares of γ, (n, 1).
    """
    lengths = torch.linalg.vector_norm(directions, dim=1, keepdim=True)
    next_inputs = directions * (learned.system.gamma * shares / lengths)
    return planning_columns(learned, project, theta, x, components, next_inputs)


def quadratic_problem(columns: Tensor, solved: Tensor) -> QuadraticProblem:
    """Return the sum of Q and of v over components k, from their :func:`planning_columns`.

    ``solved`` (n, s, c (1 + m)) are M⁻¹ times these columns.
    """
    solved = solved.mT.view_as(columns)
    Q = (columns[:, :, 1:] @ solved[:, :, 1:].mT).sum(dim=1)
    v = -(columns[:, :, 1:] @ solved[:, :, :1].mT).sum(dim=1).squeeze(-1)
    return QuadraticProblem(Q, v)


def gradient_and_changes(
    learned: LearnedDynamics, theta: Tensor, x: Tensor, components: Tensor, next_inputs: Tensor
) -> tuple[Tensor, Tensor]:
    """Return g, (n, c, q), and D B, (n, c, m, q), for components (n, c).

    They are those at the predicted state; a model that reads inputs is given the next one, which
    does not change with the input that is planned.
    """
    bar = predicted_states(learned, theta, x)
    B = learned.input_matrix(theta, bar)
    n, c, m = len(x), components.shape[1], B.shape[2]
    point = learned.points(bar, next_inputs)
    columns = learned.points(B.mT, B.new_zeros(n, m, m))
    shape = n, c, m
    g, DB = gradients_and_changes(
        learned.model,
        theta[:, None, None].expand(*shape, -1).flatten(0, 2),
        point[:, None, None].expand(*shape, -1).flatten(0, 2),
        components.unsqueeze(2).expand(shape).flatten(),
        columns.unsqueeze(1).expand(*shape, -1).flatten(0, 2),
    )
    return g.view(*shape, -1)[:, :, 0], DB.view(*shape, -1)


def best_inputs(
    gamma: float, columns: Tensor, solved: Tensor, ties: Tensor, radii: Tensor
) -> Tensor:
    """Return the inputs, (n, m), from the :func:`planning_columns` and M⁻¹ times them.

    Their norms are ``radii`` (n,) in γ.
    """
    Q, v = quadratic_problem(columns, solved)
    scale = radii.unsqueeze(-1)  # on the sphere of radius γ, the problem in u / scale has scale Q
    problem = QuadraticProblem(scale.unsqueeze(-1) * Q, v)
    return scale * d_optimal_inputs(problem, gamma, ties)


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


def uniform_inputs(learned: LearnedDynamics, theta: Tensor, states: Tensor, steps: int) -> Tensor:
    """Return the inputs, (n, m), that lead farthest from all states seen, (n, t + 1, d).

    Gradient ascent on the sphere from ±γ along every input axis, by automatic differentiation.
    """
    system, x = learned.system, states[:, -1]
    center = predicted_states(learned, theta, x).unsqueeze(1)
    B = learned.input_matrix(theta, x)
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
