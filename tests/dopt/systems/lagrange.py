"""Point masses and the forces on them, from which energies and accelerations follow.

Velocities, energies and, by the Euler-Lagrange equations, accelerations are found by automatic
differentiation.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor
from torch.func import grad, hessian, jacfwd, jvp

from dopt.systems import System


def tensor_of(values: list[float]) -> Tensor:
    """Return numbers in double precision."""
    return torch.tensor(values, dtype=torch.float64)


class Mechanics(ABC):
    """Masses and forces of one system, over generalised coordinates q and their rates."""

    coordinates: tuple[int, ...]  # indices of q in the state; the rates follow each by one

    def __init__(self, system: System) -> None:
        self.system = system

    @abstractmethod
    def masses(self) -> list[float]:
        """Return the point masses [kg]."""

    @abstractmethod
    def positions(self, q: Tensor) -> Tensor:
        """Return their positions (horizontal, upward) [m], (number of masses, 2)."""

    @abstractmethod
    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:
        """Return the generalised forces of the input."""

    @abstractmethod
    def friction(self, rates: Tensor) -> Tensor:
        """Return the generalised forces of friction."""

    def split(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return q and its rates."""
        indices = torch.tensor(self.coordinates)
        return state[indices], state[indices + 1]

    def kinetic(self, q: Tensor, rates: Tensor) -> Tensor:
        velocity = jvp(self.positions, (q,), (rates,))[1]
        return 0.5 * (tensor_of(self.masses()) * velocity.square().sum(-1)).sum()

    def potential(self, q: Tensor) -> Tensor:
        heights = self.positions(q)[:, 1]
        return self.system.gravity * (tensor_of(self.masses()) * heights).sum()

    def energy(self, state: Tensor) -> Tensor:
        q, rates = self.split(state)
        return self.kinetic(q, rates) + self.potential(q)

    def power(self, state: Tensor, u: Tensor) -> Tensor:
        """Return the power of the input less that of friction [W]."""
        q, rates = self.split(state)
        return (self.driving(q, rates, u) + self.friction(rates)) @ rates

    def accelerations(self, state: Tensor, u: Tensor) -> Tensor:
        """Return d²q/dt² by d/dt ∂L/∂q̇ - ∂L/∂q = forces."""
        q, rates = self.split(state)
        mass_matrix = hessian(self.kinetic, argnums=1)(q, rates)
        momentum_by_q = jacfwd(grad(self.kinetic, argnums=1), argnums=0)(q, rates)
        slope = grad(self.kinetic)(q, rates) - grad(self.potential)(q)
        forces = self.driving(q, rates, u) + self.friction(rates)
        return torch.linalg.solve(mass_matrix, forces + slope - momentum_by_q @ rates)
