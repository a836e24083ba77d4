"""The car and the drone as point masses in the plane and in space."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.func import jacrev

from tests.dopt.systems.lagrange import Mechanics, tensor_of


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

    def power(self, state: Tensor, u: Tensor) -> Tensor:
        self.angle = state[6]
        return super().power(state, u)

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

    def friction(self, rates: Tensor) -> Tensor:
        return torch.zeros_like(rates)


class DroneMechanics(Mechanics):
    """Masses along the three axes of the body, with the moments of inertia of the system.

    The coordinates are those of the centre and a quaternion of any norm, which the positions do not
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

    def friction(self, rates: Tensor) -> Tensor:
        return torch.zeros_like(rates)


def _quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    real = a[0] * b[0] - a[1:] @ b[1:]
    return torch.cat([real[None], a[0] * b[1:] + b[0] * a[1:] + torch.linalg.cross(a[1:], b[1:])])


def _turned(e: Tensor, vector: Tensor) -> Tensor:
    """Return a vector turned by a quaternion of any norm: e v ē / |e|²."""
    whole = torch.cat([torch.zeros_like(vector[:1]), vector])
    back = e * tensor_of([1.0, -1.0, -1.0, -1.0])
    product = _quaternion_product(_quaternion_product(e, whole), back)
    return product[1:] / e.square().sum()
