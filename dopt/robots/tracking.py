"""Tracking of references by a robot: its known body, its observed state, and computed torques."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dopt.errors import SpecificationError
from dopt.robots.body import Body, Contacts, KnownBody, poses
from dopt.robots.friction import ENCODER
from dopt.robots.limits import Limits
from dopt.types import Array

JITTER = 0.003
"""Standard deviation of torques that steps of encoders make, as a part of the limit."""

FAST = 0.3, 0.65
"""Least and most of the observer's error that a period of control removes."""

FOLLOWED = 0.27
"""Bandwidth of tracking by the observer's; errors are damped critically."""

BANDWIDTH = 75.0
"""Largest natural frequency of errors of tracking [rad/s]."""

APART, SEEN = 0.01, 0.03
"""Distance that bodies keep, for errors of tracking, and from which they are looked at [m]."""

SAME = 1e-8
"""Distance by which bodies that a joint moves together come nearer by rounding alone [m]."""

BRAKING = np.array([[0.25], [0.5], [0.75], [1.0]])
"""Parts of the time of braking after which contacts are looked for."""

TAKEN = 0.7
"""Part of the limits of torque that weight and accelerations may take."""

TRIED = 0.05
"""Part of a joint's range that it would move alone, after all have braked before a contact."""


class Tracker:
    """Observer of rates and computed torque with friction fed forward.

    Parameters
    ----------
    known : KnownBody
    limits : Limits
    friction : function
        Friction learned so far [N m], (n,), at velocities, (n,).
    dt : float
        Period of control [s].

    Attributes
    ----------
    q, v : (n,)
        Observed position and velocity.
    """

    def __init__(
        self, known: KnownBody, limits: Limits, friction: Callable[[Array], Array], dt: float
    ) -> None:
        self.known, self.limits, self.friction, self.dt = known, limits, friction, dt
        self.q: Array = np.array(known.body.home)
        self.v: Array = np.zeros(len(self.q))
        self._fast: Array = np.full(len(self.q), FAST[0])

    def place(self, q: Array) -> None:
        """Begin at rest at a position, (n,)."""
        self.q, self.v = np.array(q, dtype=float), np.zeros(len(q))

    def predict(self, a: Array) -> None:
        """Move the observed state by a period with the acceleration that is expected, (n,)."""
        self.q = self.q + self.dt * (self.v + 0.5 * self.dt * a)
        self.v = self.v + self.dt * a

    def correct(self, q: Array) -> None:
        """Correct the observed state by a measured position, (n,)."""
        missed, kept = q - self.q, 1.0 - self._fast
        self.q = self.q + (1.0 - kept**2) * missed
        self.v = self.v + self._fast**2 / self.dt * missed

    def torque(self, q: Array, v: Array, a: Array) -> Array:
        """Return torques [N m], (n,), that follow a reference, within their limits.

        Errors push their own joint alone: one that sticks would else push the others ahead.
        """
        rigid = self.known.inverse(self.q, self.v, a)
        stiffness, damping = self._gains()
        pushed = stiffness * (q - self.q) + damping * (v - self.v)
        demand = rigid + self.friction(v) + pushed
        return np.minimum(np.maximum(demand, -self.limits.torque), self.limits.torque)

    def _gains(self) -> tuple[Array, Array]:
        """Return stiffness and damping, (n,), where the known body is, and pace the observer.

        The lighter a joint is for its torque, the less the steps of its encoder shake it.
        """
        inertia = self.known.apparent_inertia()
        jitter = 2.0 * FOLLOWED * ENCODER / self.dt**2 * inertia
        self._fast = np.clip(np.cbrt(JITTER * self.limits.torque / jitter), *FAST)
        bandwidth = np.minimum(FOLLOWED * self._fast / self.dt, BANDWIDTH)
        return inertia * bandwidth**2, 2.0 * inertia * bandwidth

    def lag(self, torque: Array) -> Array:
        """Return the error of position, (n,), that feeds back a torque [N m], (n,).

        A reference that is moved back by what a better feedforward makes up for does not hurry.
        """
        return torque / self._gains()[0]


class Guard:
    """Check that a robot can brake to rest without contacts that are not there at home.

    A pose is looked at again when the joints may have moved a geom by the room that there was.

    Parameters
    ----------
    body : Body
    limits : Limits
    acceleration : (n,)
        With which each joint brakes.

    Attributes
    ----------
    needed : bool
        Whether the model has geoms that can collide.
    """

    def __init__(self, body: Body, limits: Limits, acceleration: Array) -> None:
        model, self._most = body.model, acceleration
        self.needed = bool(model.npair or (model.geom_contype | model.geom_conaffinity).any())
        self._contacts = Contacts(body, APART, SEEN)
        self._levers = self._contacts.levers(limits.position) if self.needed else np.zeros(body.n)
        self._poses, self._room = np.zeros((len(BRAKING), body.n)), np.zeros(len(BRAKING))
        self._step = np.diag(TRIED * np.ptp(limits.position, axis=1))

    def free(self, q: Array, v: Array, now: Array) -> bool:
        """Return whether bodies stay apart, or come no nearer than at the position ``now``, (n,).

        All joints brake from position q and velocity v, (n,).
        """
        if not self.needed:
            return True
        stop = np.abs(v) / self._most
        t = np.minimum(BRAKING * stop.max(), stop)
        poses = q + t * (v - 0.5 * np.sign(v) * self._most * t)
        moved = np.abs(poses - self._poses) @ self._levers
        for k in np.flatnonzero(moved >= self._room):
            room = self._contacts.room(poses[k])
            if room < 0.0 and room < self._contacts.room(now) - SAME:
                return False
            self._poses[k], self._room[k] = poses[k], room
        return True

    def open(self, q: Array, j: int) -> tuple[bool, bool]:
        """Return whether joint j may move down, and up, from a position, (n,)."""
        least = min(0.0, self._contacts.room(q)) - SAME
        below, above = (self._contacts.room(q + way * self._step[j]) for way in (-1.0, 1.0))
        return below >= least, above >= least


def possible_acceleration(known: KnownBody, limits: Limits) -> tuple[Array, Array]:
    """Return accelerations within limits that 70 % of the torques allow, and inertias: (n,).

    Gravity and the joint's own inertia are looked at in 200 random positions; the largest counts.
    """
    least, largest = np.array(limits.acceleration, dtype=float), np.zeros(len(limits.torque))
    for q in poses(limits.position, 200):
        held = np.abs(known.inverse(q, 0.0 * q, 0.0 * q))
        own = np.diag(known.mass_matrix())
        least = np.minimum(least, (TAKEN * limits.torque - held) / own)
        largest = np.maximum(largest, own)
    if least.min() <= 0.0:
        raise SpecificationError(
            f"joint '{known.body.joints[least.argmin()]}' takes more than {100.0 * TAKEN:.0f} % of "
            f"its limit of torque at rest, at some positions in the ranges that are given: give "
            f"smaller ranges, or a larger limit of torque."
        )
    return least, largest
