"""Planar quadrotor with quadratic air drag."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.declare.validated_fields import parameter
from dopt.systems.base import System
from dopt.systems.elementary import cos, magnitude, sin
from dopt.systems.features import Feature
from dopt.types import Scalar


@dataclass(frozen=True, kw_only=True)
class Quadrotor(System):
    """Rigid body in a vertical plane with two thrusters at distance r from its centre.

    State: x [m], vx [m/s], y [m], vy [m/s], tilt φ [rad], φ̇ [rad/s]. Inputs: thrusts u₁, u₂ [N].

    m v̇x = -(u₁ + u₂) sin φ - ρ |vx| vx, m v̇y = (u₁ + u₂) cos φ - m g - ρ |vy| vy,
    I φ̈ = r (u₁ - u₂). Learned: both drag accelerations. Known: gravity, thrust and torque.

    Parameters
    ----------
    mass : float
        Mass m [kg].
    inertia : float
        Moment of inertia I [kg m²].
    half_span : float
        Lever r of the thrusters [m].
    gravity : float
        Gravitational acceleration g [m/s²].
    drag : float
        Drag coefficient ρ [kg/m].
    """

    name: ClassVar[str] = "quadrotor"
    physical: ClassVar[tuple[str, ...]] = ("mass", "inertia", "half_span", "gravity", "drag")
    linear_parameters: ClassVar[tuple[str, ...]] = ("drag",)
    state_labels: ClassVar[tuple[str, ...]] = (
        "x [m]",
        "vx [m/s]",
        "y [m]",
        "vy [m/s]",
        "φ [rad]",
        "φ̇ [rad/s]",
    )
    input_labels: ClassVar[tuple[str, ...]] = ("u₁ [N]", "u₂ [N]")
    learned_rows: ClassVar[tuple[int, ...]] = (1, 3)
    features: ClassVar[tuple[Feature, ...]] = (Feature("identity", 1), Feature("identity", 3))
    angle_indices: ClassVar[tuple[int, ...]] = (4,)
    phase_plane: ClassVar[tuple[int, int]] = (1, 3)
    grid_indices: ClassVar[tuple[int, ...]] = (1, 3)

    mass: float = parameter(2.0, "kg", "positive")
    inertia: float = parameter(10.0, "kg m²", "positive")
    half_span: float = parameter(1.0, "m", "positive")
    gravity: float = parameter(1.0, "m/s²", "nonnegative")
    drag: float = parameter(0.2, "kg/m", "nonnegative")
    gamma: float = parameter(10.0, "N", "positive")
    dt: float = parameter(0.1, "s", "positive")
    initial_state: tuple[float, ...] = parameter((0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((6.3, 6.3), bound="positive")
    grid_points: tuple[int, ...] = parameter((24, 24), bound="positive")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        mass, inertia, half_span, gravity, _ = parameters
        thrust = (inputs[0] + inputs[1]) / mass
        sideways = -thrust * sin(state[4])
        upwards = thrust * cos(state[4]) - gravity
        spin = half_span * (inputs[0] - inputs[1]) / inertia
        return state[1], sideways, state[3], upwards, state[5], spin

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        mass, _, _, _, drag = parameters
        sideways, upwards = state[1], state[3]
        factor = -drag / mass
        return factor * magnitude(sideways) * sideways, factor * magnitude(upwards) * upwards
