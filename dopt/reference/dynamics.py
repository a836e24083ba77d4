"""True and learned dynamics over tensors: the equations of :mod:`dopt.systems` themselves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dopt.reference.derivatives import rows as model_rows
from dopt.reference.models import BatchModel, stack
from dopt.systems.base import System, next_state


def known_flow(system: System, x: Tensor, u: Tensor) -> Tensor:
    """Return the known part of dx/dt, (..., d), for states (..., d) and inputs (..., m)."""
    return stack(system.known(x.unbind(-1), u.unbind(-1), system.parameters))


def true_accelerations(system: System, x: Tensor, u: Tensor, step: int) -> Tensor:
    """Return a at a step, (..., r), for states (..., d) and inputs (..., m)."""
    parameters = system.history[min(step, len(system.history) - 1)].tolist()
    point = torch.cat([x, u], dim=-1) if system.reads_inputs else x
    return stack(system.accelerations(point.unbind(-1), parameters))


def flow(system: System, x: Tensor, u: Tensor, accelerations: Tensor) -> Tensor:
    """Return known(x, u) + E a, (..., d)."""
    rows = torch.tensor(system.learned_rows, device=x.device)
    return known_flow(system, x, u).index_add(-1, rows, accelerations)


def next_states(
    system: System, x: Tensor, u: Tensor, accelerations: Callable[[Tensor], Tensor], dt: float
) -> Tensor:
    """Return the states, (..., d), dt seconds after (..., d) under held inputs, (..., m).

    ``accelerations`` gives those, (..., r), of states.
    """

    def rate(z: Tensor) -> Tensor:
        return flow(system, z, u, accelerations(z))

    following: Tensor = next_state(system.integrator, rate, x, dt)
    return following


def true_next_states(system: System, step: int, x: Tensor, u: Tensor) -> Tensor:
    """Return the states, (n, d), after (n, d) under inputs (n, m) at a step, without noise."""
    return next_states(system, x, u, lambda z: true_accelerations(system, z, u, step), system.dt)


def input_matrix(system: System, x: Tensor) -> Tensor:
    """Return B = dt ∂known/∂u, (n, d, m), at states (n, d)."""
    n, d = x.shape
    with torch.enable_grad():
        u = x.new_zeros(n, d, system.n_inputs).requires_grad_()
        known = known_flow(system, x.unsqueeze(1).expand(-1, d, -1), u)
        # The i-th of d copies of the input is what the i-th state is differentiated by.
        total = known.diagonal(dim1=1, dim2=2).sum()
        if not total.requires_grad:
            return torch.zeros_like(u)
        (columns,) = torch.autograd.grad(total, u)
    return system.dt * columns


@dataclass(frozen=True)
class LearnedDynamics:
    """A system with a model in the place of the accelerations that are learned.

    Attributes
    ----------
    system : System
        Known part, γ and dt.
    model : callable
        a_θ of a batch of trials.
    n_inputs_read : int
        m where a point is a state and an input, (d + m,); 0 where it is a state, (d,).
    """

    system: System
    model: BatchModel
    n_inputs_read: int = 0

    def points(self, x: Tensor, u: Tensor) -> Tensor:
        """Return what the model depends on at states (..., d) and inputs (..., m)."""
        return torch.cat([x, u], dim=-1) if self.n_inputs_read else x

    def next_points(self, x: Tensor) -> Tensor:
        """Return points, (..., n, ·), that stand for states (..., d) without an input yet.

        These are the states themselves, or for a model that reads inputs each state under ±γ along
        each axis. The mean of JᵀJ over them is that over the sphere where J is affine in u.
        """
        if not self.n_inputs_read:
            return x.unsqueeze(-2)
        axes = self.system.gamma * torch.eye(self.n_inputs_read).to(x)
        both = torch.stack([axes, -axes], dim=1).flatten(0, 1)
        states = x.unsqueeze(-2).expand(*x.shape[:-1], len(both), -1)
        return torch.cat([states, both.expand(*x.shape[:-1], -1, -1)], dim=-1)

    def jacobian(self, theta: Tensor, points: Tensor, *, differentiable: bool = False) -> Tensor:
        """Return J, (n, N, r, q), for parameters (n, q) at points (n, N, ·)."""
        r = self.system.n_learned
        return model_rows(self.model, r, theta, points, differentiable=differentiable)

    def rows_at(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return rows, (n, N, k r, q), whose JᵀJ is the mean over :meth:`next_points`.

        Given are parameters (n, q) and states (n, N, d).
        """
        points = self.next_points(x)
        k = points.shape[-2]
        J = self.jacobian(theta, points.flatten(1, 2)).unflatten(1, (-1, k))
        rows: Tensor = J.flatten(2, 3) * k**-0.5
        return rows

    def following(self, theta: Tensor, x: Tensor, u: Tensor) -> Tensor:
        """Return x + dt f_θ(x, u), (n, N, d), for parameters (n, q), states and inputs (n, N, ·).

        Searches plan by this Euler map, whatever the integrator.
        """
        accelerations = self.model(theta, self.points(x, u))
        return x + self.system.dt * flow(self.system, x, u, accelerations)

    def next_states(self, theta: Tensor, x: Tensor, u: Tensor, dt: float) -> Tensor:
        """Return the states dt seconds later, (n, d), for (n, q), (n, d) and (n, m)."""

        def accelerations(z: Tensor) -> Tensor:
            values: Tensor = self.model(theta, self.points(z, u).unsqueeze(1)).squeeze(1)
            return values

        return next_states(self.system, x, u, accelerations, dt)

    def input_matrix(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return B = dt ∂f_θ/∂u, (n, d, m), for parameters (n, q) at states (n, d).

        What a model has learned of the inputs is taken as its secant between -γ and γ along each
        axis, exact for one that is affine in them.
        """
        columns = input_matrix(self.system, x)
        if not self.n_inputs_read:
            return columns
        values = self.model(theta, self.next_points(x))
        slopes = (values[:, ::2] - values[:, 1::2]).mT / (2.0 * self.system.gamma)
        learned = torch.tensor(self.system.learned_rows, device=x.device)
        return torch.index_add(columns, 1, learned, self.system.dt * slopes)
