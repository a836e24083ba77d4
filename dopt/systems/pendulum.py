"""Damped pendulum: a uniform rod that swings about one end."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from dopt.declare.validated_fields import parameter
from dopt.systems.base import System
from dopt.systems.elementary import sin
from dopt.systems.features import Feature
from dopt.types import Scalar


def _free_accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
    """Return the accelerations without input, for numbers, arrays and tensors."""
    mass, length, gravity, friction = parameters
    inertia = mass * length**2 / 3.0
    torque = mass * gravity * length / 2.0 * sin(state[0]) + friction * state[1]
    return (-torque / inertia,)


@dataclass(frozen=True, kw_only=True)
class Pendulum(System):
    """Uniform rod of mass m and length l on a pivot with viscous friction, driven by a torque.

    State: angle φ from hanging [rad], angular rate φ̇ [rad/s]. Input: torque u [N m].

    I φ̈ = -(m g l / 2) sin φ - b φ̇ + u with I = m l² / 3. Learned: φ̈ at u = 0. Known: u / I.
    Eigenfrequency at rest without friction: ω₀² = 3 g / (2 l).

    Parameters
    ----------
    mass : float
        Mass m [kg].
    length : float
        Length l [m].
    gravity : float
        Gravitational acceleration g [m/s²].
    friction : float
        Viscous friction coefficient b of the pivot [N m s].
    """

    name: ClassVar[str] = "pendulum"
    physical: ClassVar[tuple[str, ...]] = ("mass", "length", "gravity", "friction")
    linear_parameters: ClassVar[tuple[str, ...]] = ("gravity", "friction")
    state_labels: ClassVar[tuple[str, ...]] = ("φ [rad]", "φ̇ [rad/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [N m]",)
    learned_rows: ClassVar[tuple[int, ...]] = (1,)
    features: ClassVar[tuple[Feature, ...]] = (
        Feature("cos", 0),
        Feature("sin", 0),
        Feature("identity", 1),
    )
    angle_indices: ClassVar[tuple[int, ...]] = (0,)
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = (0, 1)
    equilibrium: ClassVar[tuple[float, ...] | None] = (0.0, 0.0)

    mass: float = parameter(1.0, "kg", "positive")
    length: float = parameter(1.0, "m", "positive")
    gravity: float = parameter(10.0, "m/s²", "nonnegative")
    friction: float = parameter(1.0 / 6.0, "N m s", "nonnegative")
    gamma: float = parameter(2.0, "N m", "positive")
    initial_state: tuple[float, ...] = parameter((1e-3, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((math.pi, 8.0), bound="positive")
    grid_points: tuple[int, ...] = parameter((32, 32), bound="positive")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        mass, length, _, _ = parameters
        return state[1], 3.0 * inputs[0] / (mass * length**2)

    accelerations = staticmethod(_free_accelerations)


@dataclass(frozen=True, kw_only=True)
class PendulumUnknownGain(Pendulum):
    """The pendulum, driven by a motor of which nobody knows what torque it gives.

    I φ̈ = -(m g l / 2) sin φ - b φ̇ + k u, all of which is learned. With k = 1 it moves as the
    pendulum does.

    Parameters
    ----------
    gain : float
        k, torque by input.
    """

    name: ClassVar[str] = "pendulum_unknown_gain"
    reads_inputs: ClassVar[bool] = True
    physical: ClassVar[tuple[str, ...]] = (*Pendulum.physical, "gain")
    linear_parameters: ClassVar[tuple[str, ...]] = (*Pendulum.linear_parameters, "gain")

    gain: float = parameter(1.0, bound="nonnegative")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:  # noqa: ARG004
        return state[1], 0.0 * state[1]

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        angle, rate, u = state
        mass, length, gravity, friction, gain = parameters
        (free,) = _free_accelerations((angle, rate), (mass, length, gravity, friction))
        return (free + 3.0 * gain * u / (mass * length**2),)
