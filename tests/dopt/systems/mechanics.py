"""Mechanics of the systems derived a second way: Lagrange, vehicles, point masses."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor
from torch.func import grad, hessian, jacfwd, jacrev, jvp

from dopt.systems import System


def tensor_of(values: list[float]) -> Tensor:
    """Return numbers in double precision."""
    return torch.tensor(values, dtype=torch.float64)


class Mechanics(ABC):
    """Masses and forces of one system, over generalised coordinates q and their rates."""

    coordinates: tuple[int, ...] = ()
    """Indices of q in the state, the angles where none are named; the rates follow each by one."""

    def __init__(self, system: System) -> None:
        self.system = system
        self.coordinates = self.coordinates or system.angle_indices

    @abstractmethod
    def masses(self) -> list[float]:
        """Return the point masses [kg]."""

    @abstractmethod
    def positions(self, q: Tensor) -> Tensor:
        """Return their positions (horizontal, upward) [m], (number of masses, 2)."""

    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:  # noqa: ARG002
        """Return the generalised forces of the input: one on each coordinate."""
        return u

    def friction(self, rates: Tensor) -> Tensor:
        """Return the generalised forces of friction: the same on each rate."""
        return -getattr(self.system, "friction", 0.0) * rates

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

    def accelerations(self, state: Tensor, u: Tensor) -> Tensor:
        """Return d²q/dt² by d/dt ∂L/∂q̇ - ∂L/∂q = forces."""
        q, rates = self.split(state)
        mass_matrix = hessian(self.kinetic, argnums=1)(q, rates)
        momentum_by_q = jacfwd(grad(self.kinetic, argnums=1), argnums=0)(q, rates)
        slope = grad(self.kinetic)(q, rates) - grad(self.potential)(q)
        forces = self.driving(q, rates, getattr(self.system, "gain", 1.0) * u)
        forces = forces + self.friction(rates)
        return torch.linalg.solve(mass_matrix, forces + slope - momentum_by_q @ rates)


class CarMechanics(Mechanics):
    """Two masses at the radius of gyration along the axis; forces act at the wheels."""

    coordinates = (0, 1, 2)

    def masses(self) -> list[float]:
        return [self.system.mass / 2] * 2

    def along_axis(self, q: Tensor, distances: Tensor) -> Tensor:
        """Return the points of the body at distances from its centre along its axis."""
        return q[:2] + distances.unsqueeze(-1) * torch.stack([q[2].cos(), q[2].sin()])

    def positions(self, q: Tensor) -> Tensor:
        gyration = math.sqrt(self.system.inertia / self.system.mass)
        return self.along_axis(q, gyration * tensor_of([-1.0, 1.0]))

    def potential(self, q: Tensor) -> Tensor:
        return 0.0 * q.sum()

    def split(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return place and heading, and their rates in the world."""
        cosine, sine = state[2].cos(), state[2].sin()
        ahead, left = state[3], state[4]
        world = [ahead * cosine - left * sine, ahead * sine + left * cosine, state[5]]
        return state[:3], torch.stack(world)

    def accelerations(self, state: Tensor, u: Tensor) -> Tensor:
        self.angle = state[6]
        return super().accelerations(state, u)

    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:
        """Return motor, drag and tyre forces, each where it acts, by virtual work."""
        axles = tensor_of([self.system.front, -self.system.rear, 0.0])
        moved = jacrev(lambda z: self.along_axis(z, axles))(q)
        velocity = moved @ rates
        headings = torch.stack([q[2] + self.angle, q[2], q[2]])
        rolling = torch.stack([headings.cos(), headings.sin()], dim=-1)
        across = torch.stack([-headings.sin(), headings.cos()], dim=-1)
        grips = tensor_of([self.system.front_grip, self.system.rear_grip, 0.0])
        speeds = (velocity.square().sum(-1) + self.system.slip_speed**2).sqrt()
        ahead = (velocity * rolling).sum(-1)[2]
        push = self.system.motor * u[0] - self.system.drag * ahead.abs() * ahead
        held = -grips * (velocity * across).sum(-1) / speeds
        forces = held.unsqueeze(-1) * across + tensor_of([0.0, 0.0, 1.0])[:, None] * push * rolling
        return torch.einsum("iaq,ia->q", moved, forces)


class DroneMechanics(Mechanics):
    """Masses along the three axes of the body, with the moments of inertia of the system.

    The coordinates are the centre's and a quaternion of any norm, which the positions do not
    depend on. A kinetic energy of the norm's own keeps it as it is.
    """

    coordinates = (0, 1, 2, 6, 7, 8, 9)

    def split(self, state: Tensor) -> tuple[Tensor, Tensor]:
        turns = 0.5 * _quaternion_product(state[6:10], torch.cat([0.0 * state[:1], state[10:]]))
        return state[list(self.coordinates)], torch.cat([state[3:6], turns])

    def masses(self) -> list[float]:
        """Return two on each axis, 1 m from the centre, and the rest, of whatever sign, there."""
        across = self.system.inertia_z / 4
        along = (self.system.inertia - 2 * across) / 2
        return [across] * 4 + [along] * 2 + [self.system.mass - 4 * across - 2 * along]

    def points(self, q: Tensor, places: Tensor) -> Tensor:
        """Return the points of the body, in the world, at places in its frame, (n, 3)."""
        return q[:3] + torch.stack([_turned(q[3:], place) for place in places])

    def positions(self, q: Tensor) -> Tensor:
        axes = torch.eye(3, dtype=torch.float64)
        ends = [sign * axes[i] for i in range(3) for sign in (1, -1)]
        return self.points(q, torch.stack([*ends, 0.0 * axes[0]]))

    def kinetic(self, q: Tensor, rates: Tensor) -> Tensor:
        return super().kinetic(q, rates) + 0.5 * (q[3:] @ rates[3:]).square()

    def potential(self, q: Tensor) -> Tensor:
        return self.system.mass * self.system.gravity * q[2]

    def body_rates(self, q: Tensor, rates: Tensor) -> Tensor:
        back = q[3:] * tensor_of([1.0, -1.0, -1.0, -1.0])
        return 2.0 * _quaternion_product(back, rates[3:])[1:] / q[3:].square().sum()

    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:
        """Return thrusts at the ends of the arms, torques and drag, by virtual work."""
        system = self.system
        arms = system.half_span * tensor_of([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]])
        moved = jacrev(lambda z: self.points(z, arms))(q)
        upwards = _turned(q[3:], tensor_of([0.0, 0.0, 1.0]))
        thrusts = u + system.mass * system.gravity / 4
        lifted = torch.einsum("iaq,a,i->q", moved, upwards, thrusts)
        omega = self.body_rates(q, rates)
        rate = (omega.square().sum() + system.slow_rate**2).sqrt()
        propellers = system.propeller_torque * (thrusts @ tensor_of([1.0, -1.0, 1.0, -1.0]))
        torque = tensor_of([0.0, 0.0, 1.0]) * propellers - system.turn_drag * rate * omega
        turned = torque @ jacrev(self.body_rates, argnums=1)(q, rates)
        v = rates[:3]
        slowed = -system.drag * (v.square().sum() + system.slow_speed**2).sqrt() * v
        return lifted + turned + torch.cat([slowed, torch.zeros_like(q[3:])])


def _quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    real = a[0] * b[0] - a[1:] @ b[1:]
    return torch.cat([real[None], a[0] * b[1:] + b[0] * a[1:] + torch.linalg.cross(a[1:], b[1:])])


def _turned(e: Tensor, vector: Tensor) -> Tensor:
    """Return a vector turned by a quaternion of any norm: e v ē / |e|²."""
    whole = torch.cat([torch.zeros_like(vector[:1]), vector])
    back = e * tensor_of([1.0, -1.0, -1.0, -1.0])
    product = _quaternion_product(_quaternion_product(e, whole), back)
    return product[1:] / e.square().sum()


class PendulumMechanics(Mechanics):
    def masses(self) -> list[float]:
        return [self.system.mass / 2, self.system.mass / 2]

    def positions(self, q: Tensor) -> Tensor:
        gauss = tensor_of([0.5 - 0.5 / math.sqrt(3), 0.5 + 0.5 / math.sqrt(3)])
        radius = self.system.length * gauss
        return torch.stack([radius * q[0].sin(), -radius * q[0].cos()], dim=-1)


class UnbalancedDiskMechanics(Mechanics):
    """Unit inertia: a unit mass at the end of a rod of 1 m."""

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
    def masses(self) -> list[float]:
        return [self.system.mass_1, self.system.mass_2]

    def positions(self, q: Tensor) -> Tensor:
        lengths = tensor_of([self.system.length_1, self.system.length_2])
        links = torch.stack([lengths * q.sin(), -lengths * q.cos()], dim=-1)
        return links.cumsum(0)


class ChainMechanics(Mechanics):
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


class CoupledPendulumsMechanics(Mechanics):
    """Unit masses at the ends of rods of 1 m, with torsion springs between neighbours."""

    def masses(self) -> list[float]:
        return [1.0] * self.system.n_pendulums

    def positions(self, q: Tensor) -> Tensor:
        return torch.stack([q.sin(), -q.cos()], dim=-1)

    def potential(self, q: Tensor) -> Tensor:
        twists = torch.diff(q)
        return super().potential(q) + 0.5 * self.system.coupling * twists.square().sum()

    def driving(self, q: Tensor, rates: Tensor, u: Tensor) -> Tensor:  # noqa: ARG002
        return torch.cat([u, torch.zeros_like(q[1:])])


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


MECHANICS: dict[str, type[Mechanics]] = {
    "pendulum": PendulumMechanics,
    "cartpole": CartpoleMechanics,
    "arm": ArmMechanics,
    "quadrotor": QuadrotorMechanics,
    "mass_spring": MassSpringMechanics,
    "drifting_pendulum": PendulumMechanics,
    "chain": ChainMechanics,
    "pendulum_unknown_gain": PendulumMechanics,
    "cartpole_unknown_gain": CartpoleMechanics,
    "unbalanced_disk": UnbalancedDiskMechanics,
    "coupled_pendulums": CoupledPendulumsMechanics,
    "van_der_pol": VanDerPolMechanics,
    "car": CarMechanics,
    "drone": DroneMechanics,
}

WITHOUT_INERTIA = ("moving_star",)
"""Systems of first order, which have no kinetic energy: each has tests of its own."""
