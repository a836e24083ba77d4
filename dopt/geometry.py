"""Drawings of systems in a plane as polylines and masses; vertical, or the plane they move on.

A custom system gets a drawing by registering one::

    @body.register
    def _(system: MySystem, states: Array) -> Body: ...
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import singledispatch

import numpy as np
import numpy.typing as npt

from dopt.systems import (
    Arm,
    Car,
    Cartpole,
    Chain,
    CoupledPendulums,
    Drone,
    MassSpring,
    MovingStar,
    Pendulum,
    Quadrotor,
    System,
    UnbalancedDisk,
    VanDerPol,
)

Array = npt.NDArray[np.float64]

CART = (0.3, 0.12)
"""Half the length and half the height of the cart that is drawn, by the rod's length."""

SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
"""Corners of a square about the origin, from one back to it."""

WHEEL = 0.4
"""Half the length of a steered wheel that is drawn, by its distance from the centre of mass."""

BLOCK = 0.3
"""Half the side of a mass between springs that is drawn [m]; at rest they are 2 m apart."""


RIM = 1.2
"""Radius of the disk that is drawn [m]; its weight is 1 m from the centre."""


@dataclass(frozen=True)
class Body:
    """A system in a vertical plane [m], x to the right and y up.

    Attributes
    ----------
    lines : tuple of (n, k, 2)
        Polylines of k points, for each of n states.
    masses : (n, p, 2)
        Points at which masses sit.
    """

    lines: tuple[Array, ...]
    masses: Array


@singledispatch
def body(system: System, states: Array) -> Body | None:  # noqa: ARG001  # its variants need them
    """Return the body of a system at states (n, d); None for a system that has none."""
    return None


@body.register
def _(system: Pendulum, states: Array) -> Body:
    tip = _hanging(states[:, 0], system.length)
    return Body((_polyline(np.zeros_like(tip), tip),), tip[:, None])


@body.register
def _(system: UnbalancedDisk, states: Array) -> Body:  # noqa: ARG001  # its class decides
    weight = _hanging(states[:, 0], 1.0)
    turn = np.linspace(0.0, 2.0 * np.pi, 25)
    rim = RIM * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    spoke = _polyline(np.zeros_like(weight), weight)
    return Body((np.broadcast_to(rim, (len(states), *rim.shape)), spoke), weight[:, None])


@body.register
def _(system: Cartpole, states: Array) -> Body:
    cart = np.stack([states[:, 0], np.zeros(len(states))], axis=1)
    tip = cart - _hanging(-states[:, 2], system.length)  # the angle is from upright
    corners = system.length * np.array(CART) * SQUARE
    return Body((cart[:, None] + corners, _polyline(cart, tip)), tip[:, None])


@body.register
def _(system: Car, states: Array) -> Body:
    axis = np.stack([np.cos(states[:, 2]), np.sin(states[:, 2])], axis=1)
    front, rear = states[:, :2] + system.front * axis, states[:, :2] - system.rear * axis
    heading = states[:, 2] + states[:, 6]
    wheel = WHEEL * system.front * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    lines = _polyline(rear, front), _polyline(front - wheel, front + wheel)
    return Body(lines, states[:, None, :2])


@body.register
def _(system: Arm, states: Array) -> Body:
    elbow = _hanging(states[:, 0], system.length_1)
    hand = elbow + _hanging(states[:, 2], system.length_2)
    return Body((_polyline(np.zeros_like(elbow), elbow, hand),), np.stack([elbow, hand], axis=1))


@body.register
def _(system: Chain, states: Array) -> Body:
    links = [_hanging(states[:, i], system.length) for i in system.angle_indices]
    masses = np.cumsum(links, axis=0)
    return Body((_polyline(np.zeros_like(masses[0]), *masses),), np.moveaxis(masses, 0, 1))


@body.register
def _(system: CoupledPendulums, states: Array) -> Body:
    tips, pivots = [], []
    for column, index in enumerate(system.angle_indices):
        pivots.append(np.broadcast_to([2.0 * column, 0.0], (len(states), 2)))
        tips.append(pivots[-1] + _hanging(states[:, index], 1.0))
    rods = tuple(_polyline(pivot, tip) for pivot, tip in zip(pivots, tips, strict=True))
    return Body(rods, np.stack(tips, axis=1))


@body.register
def _(system: MovingStar, states: Array) -> Body:
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    orbit = system.orbit * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return Body((np.broadcast_to(orbit, (len(states), *orbit.shape)),), states[:, None])


@body.register
def _(system: Quadrotor, states: Array) -> Body:
    centre, tilt = states[:, [0, 2]], states[:, 4]
    arm = system.half_span * np.stack([np.cos(tilt), np.sin(tilt)], axis=1)
    return Body((_polyline(centre - arm, centre + arm),), centre[:, None])


@body.register
def _(system: VanDerPol, states: Array) -> Body:  # noqa: ARG001  # its class decides
    mass = np.stack([states[:, 0], np.zeros(len(states))], axis=1)
    return Body((mass[:, None] + BLOCK * SQUARE,), mass[:, None])


@body.register
def _(system: Drone, states: Array) -> Body:
    centre, turn = states[:, [0, 2]], np.linspace(0.0, 2.0 * np.pi, 25)
    sphere = system.half_span * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return Body((centre[:, None] + sphere,), centre[:, None])


@body.register
def _(system: MassSpring, states: Array) -> Body:  # noqa: ARG001  # its class decides
    level = np.zeros(len(states))
    masses = [np.stack([rest + states[:, i], level], axis=1) for rest, i in ((-1, 0), (1, 2))]
    corners = BLOCK * SQUARE
    return Body(tuple(mass[:, None] + corners for mass in masses), np.stack(masses, axis=1))


def _hanging(angle: Array, length: float) -> Array:
    """Return the end (n, 2) of a rod from the origin, at an angle from hanging."""
    return length * np.stack([np.sin(angle), -np.cos(angle)], axis=1)


def _polyline(*points: Array) -> Array:
    return np.stack(points, axis=1)
