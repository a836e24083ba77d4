"""Plants that the tests of explorations measure."""

from __future__ import annotations

import numpy as np

from dopt import Plant
from dopt.types import Array

MOTOR = Plant(
    states={"angle": "rad", "rate": "rad/s"},
    inputs={"voltage": "V"},
    dt=0.02,
    gamma=6.0,
    known={"angle": "rate", "rate": "gain * voltage"},
    constants={"gain": 5.0},
    learned=["rate"],
    angles=["angle"],
    box={"rate": 10.0},
)
"""A motor that lifts an unbalanced disk."""


def motor_acceleration(x: Array) -> float:
    """Return what the exploration learns of the motor."""
    return float(-8.0 * np.sin(x[0]) - 0.6 * x[1])


def following(x: Array, u: Array, dt: float = MOTOR.dt) -> Array:
    """Return the state of the motor dt seconds later, by the Euler map."""
    return x + dt * np.array([x[1], 5.0 * u[0] + motor_acceleration(x)])


HOVERCRAFT = Plant(
    states={"speed": "m/s", "heading": "rad", "spin": "rad/s"},
    inputs={"thrust": "N", "torque": "N m"},
    dt=0.02,
    gamma=4.0,
    known={"speed": "thrust", "heading": "spin", "spin": "2 * torque"},
    learned=["speed", "spin"],
    angles=["heading"],
    box={"speed": 2.0, "spin": 3.0},
)
"""A plant of two inputs, whose plans are points of a circle and not one of two numbers."""


def steered(x: Array, u: Array, dt: float = HOVERCRAFT.dt) -> Array:
    """Return the state of the hovercraft dt seconds later."""
    drag, wind = -0.8 * x[0] * abs(x[0]), np.sin(x[1])
    return x + dt * np.array([u[0] + drag + wind, x[2], 2.0 * u[1] - 0.5 * x[2]])
