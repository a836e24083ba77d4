"""The systems as masses in a plane, from positions alone: what their equations are held against.

A body is given by the positions of point masses, and every force by where it acts; the rest follows
(:mod:`tests.dopt.systems.lagrange`). A uniform rod is two masses at the Gauss points of its length,
a rigid body two masses at its radius of gyration: their kinetic energies are the exact ones.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.func import grad, jacrev

from dopt.systems import (
    Arm,
    Car,
    Cartpole,
    CartpoleUnknownGain,
    Chain,
    CoupledPendulums,
    DriftingPendulum,
    Drone,
    MassSpring,
    Pendulum,
    PendulumUnknownGain,
    Quadrotor,
    System,
    UnbalancedDisk,
    VanDerPol,
)
from tests.dopt.systems.lagrange import Mechanics, tensor_of
from tests.dopt.systems.vehicle_mechanics import CarMechanics, DroneMechanics


class PendulumMechanics(Mechanics):
    coordinates = (0,)

    def masses(self) -> list[float]:
        return [self.system.mass / 2, self.system.mass / 2]

    def positions(self, q: Tensor) -> Tensor:
        gauss = tensor_of([0.5 - 0.5 / math.sqrt(3), 0.5 + 0.5 / math.sqrt(3)])
        radius = self.system.length * gauss
        return torch.stack([radius * q[0].sin(), -radius * q[0].cos()], dim=-1)

    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:  # noqa: ARG002
        return u

    def friction(self, rates: Tensor) -> Tensor:
        return -self.system.friction * rates


class UnbalancedDiskMechanics(Mechanics):
    """Unit inertia: a unit mass at the end of a rod of 1 m."""

    coordinates = (0,)

    def masses(self) -> list[float]:
        return [1.0]

    def positions(self, q: Tensor) -> Tensor:
        return torch.stack([q[0].sin(), -q[0].cos()]).unsqueeze(0)

    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:  # noqa: ARG002
        return self.system.motor_gain * u

    def friction(self, rates: Tensor) -> Tensor:
        dry = self.system.dry_friction * torch.tanh(rates / self.system.dry_rate)
        return -self.system.friction * rates - dry


class CartpoleMechanics(Mechanics):
    coordinates = (0, 2)

    def masses(self) -> list[float]:
        return [self.system.cart_mass, self.system.pole_mass]

    def positions(self, q: Tensor) -> Tensor:
        cart = torch.stack([q[0], torch.zeros_like(q[0])])
        rod = self.system.length * torch.stack([q[1].sin(), q[1].cos()])
        return torch.stack([cart, cart + rod])

    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:  # noqa: ARG002
        """Return the force on the cart, by virtual work."""
        return jacrev(self.positions)(q)[0, 0] * u[0]

    def friction(self, rates: Tensor) -> Tensor:
        coefficients = [self.system.cart_friction, self.system.pivot_friction]
        return -tensor_of(coefficients) * rates


class ArmMechanics(Mechanics):
    coordinates = (0, 2)

    def masses(self) -> list[float]:
        return [self.system.mass_1, self.system.mass_2]

    def positions(self, q: Tensor) -> Tensor:
        lengths = tensor_of([self.system.length_1, self.system.length_2])
        links = torch.stack([lengths * q.sin(), -lengths * q.cos()], dim=-1)
        return links.cumsum(0)

    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:  # noqa: ARG002
        return u

    def friction(self, rates: Tensor) -> Tensor:
        return -self.system.friction * rates


class ChainMechanics(Mechanics):
    def __init__(self, system: System) -> None:
        super().__init__(system)
        self.coordinates = system.angle_indices

    def masses(self) -> list[float]:
        return [self.system.mass] * self.system.n_links

    def positions(self, q: Tensor) -> Tensor:
        links = self.system.length * torch.stack([q.sin(), -q.cos()], dim=-1)
        return links.cumsum(0)

    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:
        """Return the torques of motors that feel the joints' relative angles, by virtual work."""

        def joints(angles: Tensor) -> Tensor:
            return torch.diff(angles, prepend=torch.zeros_like(angles[:1]))

        return jacrev(joints)(q).mT @ u + 0.0 * rates

    def friction(self, rates: Tensor) -> Tensor:
        return -self.system.friction * rates


class CoupledPendulumsMechanics(Mechanics):
    """Unit masses at the ends of rods of 1 m, with torsion springs between neighbours."""

    def __init__(self, system: System) -> None:
        super().__init__(system)
        self.coordinates = system.angle_indices

    def masses(self) -> list[float]:
        return [1.0] * self.system.n_pendulums

    def positions(self, q: Tensor) -> Tensor:
        return torch.stack([q.sin(), -q.cos()], dim=-1)

    def potential(self, q: Tensor) -> Tensor:
        twists = torch.diff(q)
        return super().potential(q) + 0.5 * self.system.coupling * twists.square().sum()

    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:  # noqa: ARG002
        return torch.cat([u, torch.zeros_like(q[1:])])

    def friction(self, rates: Tensor) -> Tensor:
        return -self.system.friction * rates


class QuadrotorMechanics(Mechanics):
    coordinates = (0, 2, 4)

    def masses(self) -> list[float]:
        return [self.system.mass / 2, self.system.mass / 2]

    def along_span(self, q: Tensor, distances: Tensor) -> Tensor:
        """Return the points of the body at distances from its centre along the span."""
        span = torch.stack([q[2].cos(), q[2].sin()])
        return q[:2] + distances.unsqueeze(-1) * span

    def positions(self, q: Tensor) -> Tensor:
        gyration = math.sqrt(self.system.inertia / self.system.mass)
        return self.along_span(q, gyration * tensor_of([-1.0, 1.0]))

    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:  # noqa: ARG002
        """Return the two thrusts, each at its end of the span and upwards in the body's frame."""
        ends = self.system.half_span * tensor_of([1.0, -1.0])
        moved = jacrev(lambda z: self.along_span(z, ends))(q)
        upwards = torch.stack([-q[2].sin(), q[2].cos()])
        return torch.einsum("iaq,a,i->q", moved, upwards, u)

    def friction(self, rates: Tensor) -> Tensor:
        drag = -self.system.drag * rates.abs() * rates
        return drag * tensor_of([1.0, 1.0, 0.0])


class MassSpringMechanics(Mechanics):
    """Three springs, each with a damper, between two walls and two masses on a level line."""

    coordinates = (0, 2)

    def masses(self) -> list[float]:
        return [self.system.mass, self.system.mass]

    def positions(self, q: Tensor) -> Tensor:
        return torch.stack([q, torch.zeros_like(q)], dim=-1)

    def extensions(self, q: Tensor) -> Tensor:
        """Return by how much each spring is longer than at rest."""
        return torch.stack([q[0], q[1] - q[0], -q[1]])

    def potential(self, q: Tensor) -> Tensor:
        return 0.5 * self.system.stiffness * self.extensions(q).square().sum()

    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:  # noqa: ARG002
        return u

    def friction(self, rates: Tensor) -> Tensor:
        """Return the slope of Rayleigh's dissipation, half of each damper's power."""

        def dissipation(v: Tensor) -> Tensor:
            return 0.5 * self.system.damping * self.extensions(v).square().sum()

        return -grad(dissipation)(rates)


class VanDerPolMechanics(Mechanics):
    """A unit mass on a spring; its damping depends on where it is and may feed it."""

    coordinates = (0,)

    def masses(self) -> list[float]:
        return [1.0]

    def positions(self, q: Tensor) -> Tensor:
        return torch.stack([q[0], torch.zeros_like(q[0])]).unsqueeze(0)

    def potential(self, q: Tensor) -> Tensor:
        return 0.5 * self.system.stiffness * q.square().sum()

    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:
        """Return the input and the damping, which changes its sign at the amplitude."""
        inside = 1.0 - (q / self.system.amplitude).square()
        return u + self.system.damping * inside * rates

    def friction(self, rates: Tensor) -> Tensor:
        return torch.zeros_like(rates)


class PendulumUnknownGainMechanics(PendulumMechanics):
    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:
        return super().driving(q, rates, self.system.gain * u)


class CartpoleUnknownGainMechanics(CartpoleMechanics):
    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:
        return super().driving(q, rates, self.system.gain * u)


MECHANICS: dict[type[System], type[Mechanics]] = {
    Pendulum: PendulumMechanics,
    Cartpole: CartpoleMechanics,
    Arm: ArmMechanics,
    Quadrotor: QuadrotorMechanics,
    MassSpring: MassSpringMechanics,
    DriftingPendulum: PendulumMechanics,
    Chain: ChainMechanics,
    PendulumUnknownGain: PendulumUnknownGainMechanics,
    CartpoleUnknownGain: CartpoleUnknownGainMechanics,
    UnbalancedDisk: UnbalancedDiskMechanics,
    CoupledPendulums: CoupledPendulumsMechanics,
    VanDerPol: VanDerPolMechanics,
    Car: CarMechanics,
    Drone: DroneMechanics,
}

WITHOUT_INERTIA = ("moving_star",)
"""Systems of first order, which have no kinetic energy: each has tests of its own."""

FRICTION = {
    "pendulum": ("friction",),
    "cartpole": ("pivot_friction", "cart_friction"),
    "arm": ("friction",),
    "quadrotor": ("drag",),
    "mass_spring": ("damping",),
    "drifting_pendulum": ("friction", "final_friction"),
    "chain": ("friction",),
    "pendulum_unknown_gain": ("friction",),
    "cartpole_unknown_gain": ("pivot_friction", "cart_friction"),
    "unbalanced_disk": ("friction", "dry_friction"),
    "coupled_pendulums": ("friction",),
    "van_der_pol": ("damping",),
    "car": ("front_grip", "rear_grip", "drag"),
    "drone": ("drag", "turn_drag"),
}

HOVERING = ("drone",)
"""Systems that thrust carries without an input, which may feed them energy."""

SELF_EXCITED = ("van_der_pol",)
"""Systems whose friction feeds energy at some states."""
