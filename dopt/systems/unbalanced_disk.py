"""Unbalanced disk: a weight on a disk that a motor turns, with dry friction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from dopt.declare.validated_fields import parameter
from dopt.systems.base import System
from dopt.systems.elementary import sin, tanh
from dopt.systems.features import Feature
from dopt.types import Scalar


@dataclass(frozen=True, kw_only=True)
class UnbalancedDisk(System):
    """Disk with a weight off its centre, turned by a voltage.

    State: angle y from hanging [rad], rate ω [rad/s]. Input: voltage u [V].

    dω/dt = -ω₀² sin y - b ω - c tanh(ω / ω_c) + k u. Learned: dω/dt at u = 0. Known: k u.

    The numbers are those of the laboratory's disk that exercises of system identification simulate.
    There ω_c is 0.001 rad/s, which asks for steps far below dt; at 0.1 rad/s the friction turns
    sign as fast as the Euler map can follow.

    Parameters
    ----------
    gravity : float
        ω₀², angular acceleration of the weight when it is level [rad/s²].
    friction : float
        Viscous friction b [1/s].
    dry_friction : float
        Coulomb friction c [rad/s²].
    dry_rate : float
        Rate ω_c at which the dry friction has 76 % of its value [rad/s].
    motor_gain : float
        k [rad/(V s²)].
    """

    name: ClassVar[str] = "unbalanced_disk"
    physical: ClassVar[tuple[str, ...]] = (
        *("gravity", "friction", "dry_friction", "dry_rate", "motor_gain"),
    )
    linear_parameters: ClassVar[tuple[str, ...]] = ("gravity", "friction", "dry_friction")
    state_labels: ClassVar[tuple[str, ...]] = ("y [rad]", "ω [rad/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [V]",)
    learned_rows: ClassVar[tuple[int, ...]] = (1,)
    features: ClassVar[tuple[Feature, ...]] = (
        Feature("cos", 0),
        Feature("sin", 0),
        Feature("identity", 1),
    )
    angle_indices: ClassVar[tuple[int, ...]] = (0,)
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = (0, 1)

    gravity: float = parameter(128.6, "rad/s²", "nonnegative")
    friction: float = parameter(1.333, "1/s", "nonnegative")
    dry_friction: float = parameter(6.063, "rad/s²", "nonnegative")
    dry_rate: float = parameter(0.1, "rad/s", "positive")
    motor_gain: float = parameter(28.14, "rad/(V s²)", "positive")
    gamma: float = parameter(3.0, "V", "positive")
    dt: float = parameter(0.01, "s", "positive")
    initial_state: tuple[float, ...] = parameter((1e-3, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((math.pi, 20.0), bound="positive")
    grid_points: tuple[int, ...] = parameter((32, 32), bound="positive")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        return state[1], parameters[4] * inputs[0]

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        angle, rate = state
        gravity, friction, dry_friction, dry_rate, _ = parameters
        dry = dry_friction * tanh(rate / dry_rate)
        return (-gravity * sin(angle) - friction * rate - dry,)
