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
from torch.func import grad, jvp, vmap

from dopt.algorithm import TIE_MARGIN
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


def quadratic_problem(
    learned: LearnedDynamics,
    theta: Tensor,
    information: Tensor,
    x: Tensor,
    components: Tensor,
    next_inputs: Tensor,
    project: Callable[[Tensor], Tensor],
) -> QuadraticProblem:
    """Return Q and v for parameters (n, q), M (n, s, s), states (n, d), components k (n,).

    ``next_inputs`` (n, m) are those of the next sample, for a model that reads inputs.
    ``project`` maps gradients, (..., q), to the space of M, (..., s): the identity, or a sketch.
    """
    bar = predicted_states(learned, theta, x)
    g, DB = vmap(lambda p, z, v, k: _gradient_and_changes(learned, p, z, v, k))(
        theta, bar, next_inputs, components
    )
    columns = project(torch.cat([g.unsqueeze(-1), DB], dim=-1).mT).mT
    solved = torch.cholesky_solve(columns, _factor(information))
    Q = columns[..., 1:].mT @ solved[..., 1:]
    v = -(columns[..., 1:].mT @ solved[..., :1]).squeeze(-1)
    return QuadraticProblem(Q, v)


def summed(problems: list[QuadraticProblem]) -> QuadraticProblem:
    """Return the problem whose objective is the sum of all."""
    return QuadraticProblem(
        torch.stack([problem.Q for problem in problems]).sum(dim=0),
        torch.stack([problem.v for problem in problems]).sum(dim=0),
    )


def _factor(information: Tensor) -> Tensor:
    """Return the Cholesky factors of M; NaN where M is not positive definite, or NaN itself."""
    factor, failed = torch.linalg.cholesky_ex(information)
    return torch.where((failed == 0)[:, None, None], factor, torch.nan)


def _gradient_and_changes(
    learned: LearnedDynamics, theta: Tensor, bar: Tensor, next_input: Tensor, component: Tensor
) -> tuple[Tensor, Tensor]:
    """Return g, (q,), and D B, (q, m), by forward over reverse differentiation.

    They are those at the predicted state; a model that reads inputs is given the next one, which
    does not change with the input that is planned.
    """

    def chosen(parameters: Tensor, z: Tensor) -> Tensor:
        return learned.model(parameters, z).gather(-1, component.view(1)).squeeze(-1)

    def gradient(z: Tensor) -> Tensor:
        g: Tensor = grad(chosen)(theta, z)
        return g

    columns = learned.input_matrix(theta, bar)
    point = learned.points(bar, next_input)
    columns = learned.points(columns.mT, columns.new_zeros(columns.shape[1], columns.shape[1])).mT
    change = vmap(lambda column: jvp(gradient, (point,), (column,))[1], in_dims=1, out_dims=1)
    return gradient(point), change(columns)


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
    center = predicted_states(learned, theta, x)
    B = vmap(learned.input_matrix)(theta, x)
    axes = torch.eye(system.n_inputs, dtype=x.dtype, device=x.device)
    starts = system.gamma * torch.stack([axes, -axes], dim=1).flatten(0, 1)

    def distance(u: Tensor, c: Tensor, columns: Tensor, seen: Tensor) -> Tensor:
        total: Tensor = torch.linalg.vector_norm(c + columns @ u - seen, dim=-1).sum()
        return total

    def ascent(u: Tensor, c: Tensor, columns: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        for _ in range(steps if system.n_inputs > 1 else 0):
            slope = grad(distance)(u, c, columns, seen)
            u = system.gamma * slope / torch.linalg.vector_norm(slope)
        return u, distance(u, c, columns, seen)

    over_starts = vmap(ascent, in_dims=(0, None, None, None))
    u, value = vmap(over_starts, in_dims=(None, 0, 0, 0))(starts, center, B, states)
    best, best_value = u[:, 0], value[:, 0]
    for i in range(1, len(starts)):
        better = value[:, i] > best_value * (1 + TIE_MARGIN)
        best = torch.where(better.unsqueeze(-1), u[:, i], best)
        best_value = torch.where(better, value[:, i], best_value)
    return best
