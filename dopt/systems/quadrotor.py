"""Quadrotors: the paper's in a plane, and one in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.fields import parameter
from dopt.systems.base import Feature, System, identity
from dopt.systems.elementary import cos, magnitude, sin
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
    features: ClassVar[tuple[Feature, ...]] = identity(1, 3)
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


NORM_RATE = 10.0
"""Rate at which the norm of the quaternion returns to 1 [1/s]; Euler steps lead away from it."""


@dataclass(frozen=True, kw_only=True)
class Drone(System):
    """Rigid body in space with four thrusters at the ends of a cross.

    State: position x, y, z [m] and velocity v [m/s] in the world, z up; unit quaternion e₀ … e₃
    that turns the body's axes into the world's; angular rates ω = p, q, r [rad/s] about the body's.
    Inputs: thrusts u₁ … u₄ [N] along the body's z axis, each beyond a quarter of the weight, at the
    distance l ahead, to the left, behind and to the right of the centre.

    m v̇ = (m g + Σ u) R e_z - m g e_z - ρ √(|v|² + v₀²) v, with R the matrix of the quaternion,
    J ω̇ = M u - ω × J ω - κ √(|ω|² + ω₀²) ω, with J = diag(I, I, I_z) and
    M u = (l (u₂ - u₄), l (u₃ - u₁), h (u₁ - u₂ + u₃ - u₄)).
    Learned: the accelerations of both drags, quadratic far above v₀ and ω₀ and linear below. Known:
    all other terms. Without inputs an upright drone hovers.

    Source: R. Beard and T. McLain, "Small unmanned aircraft" (2012), for the equations in a
    quaternion and the term that keeps its norm.

    Parameters
    ----------
    mass : float
        m [kg].
    inertia, inertia_z : float
        I about the arms of the cross, and I_z about the axis of the thrusts [kg m²].
    half_span : float
        l [m].
    propeller_torque : float
        h, torque of a propeller by its thrust [m].
    gravity : float
        g [m/s²].
    drag : float
        ρ [kg/m].
    turn_drag : float
        κ [kg m²].
    slow_speed, slow_rate : float
        v₀ [m/s] and ω₀ [rad/s].

    Notes
    -----
    Reasons for the default values:

    - mass, inertia, half_span: a drone of 1 kg and 40 cm.
    - drag: 0.25 kg/m: its weight drives it to 6.3 m/s at most.
    - turn_drag: turns at full thrust of two motors reach 4 rad/s.
    - gamma: 1 N beside thrusts of 2.5 N each that carry the weight: no motor has to turn round.
    - grid: speeds and rates up to these limits. Six axes: the points are a Sobol set.
    - horizon: 10 s: the drone turns over several times.
    """

    name: ClassVar[str] = "drone"
    physical: ClassVar[tuple[str, ...]] = (
        *("mass", "inertia", "inertia_z", "half_span", "propeller_torque", "gravity"),
        *("drag", "turn_drag", "slow_speed", "slow_rate"),
    )
    linear_parameters: ClassVar[tuple[str, ...]] = ("drag", "turn_drag")
    state_labels: ClassVar[tuple[str, ...]] = (
        *("x [m]", "y [m]", "z [m]", "vx [m/s]", "vy [m/s]", "vz [m/s]"),
        *("e₀ [1]", "e₁ [1]", "e₂ [1]", "e₃ [1]", "p [rad/s]", "q [rad/s]", "r [rad/s]"),
    )
    input_labels: ClassVar[tuple[str, ...]] = ("u₁ [N]", "u₂ [N]", "u₃ [N]", "u₄ [N]")
    learned_rows: ClassVar[tuple[int, ...]] = (3, 4, 5, 10, 11, 12)
    features: ClassVar[tuple[Feature, ...]] = identity(3, 4, 5, 10, 11, 12)
    phase_plane: ClassVar[tuple[int, int]] = (3, 5)
    grid_indices: ClassVar[tuple[int, ...]] = (3, 4, 5, 10, 11, 12)
    low_discrepancy: ClassVar[bool] = True

    mass: float = parameter(1.0, "kg", "positive")
    inertia: float = parameter(0.01, "kg m²", "positive")
    inertia_z: float = parameter(0.018, "kg m²", "positive")
    half_span: float = parameter(0.2, "m", "positive")
    propeller_torque: float = parameter(0.05, "m", "positive")
    gravity: float = parameter(9.81, "m/s²", "nonnegative")
    drag: float = parameter(0.25, "kg/m", "nonnegative")
    turn_drag: float = parameter(0.012, "kg m²", "nonnegative")
    slow_speed: float = parameter(0.5, "m/s", "positive")
    slow_rate: float = parameter(1.0, "rad/s", "positive")
    gamma: float = parameter(1.0, "N", "positive")
    initial_state: tuple[float, ...] = parameter((*[0.0] * 6, 1.0, *[0.0] * 6))
    grid_half_widths: tuple[float, ...] = parameter(
        (6.0, 6.0, 6.0, 4.0, 4.0, 2.0), bound="positive"
    )
    grid_points: tuple[int, ...] = parameter((1024,), bound="positive")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        e_0, e_1, e_2, e_3, p, q, r = state[6:]
        mass, inertia, inertia_z, half_span, propeller_torque, gravity = parameters[:6]
        lift = gravity + (inputs[0] + inputs[1] + inputs[2] + inputs[3]) / mass
        back = NORM_RATE * (1.0 - e_0 * e_0 - e_1 * e_1 - e_2 * e_2 - e_3 * e_3)
        gyration = (inertia_z - inertia) * r
        spin = inputs[0] - inputs[1] + inputs[2] - inputs[3]
        return (
            state[3],
            state[4],
            state[5],
            2.0 * (e_1 * e_3 + e_0 * e_2) * lift,
            2.0 * (e_2 * e_3 - e_0 * e_1) * lift,
            (e_0 * e_0 - e_1 * e_1 - e_2 * e_2 + e_3 * e_3) * lift - gravity,
            back * e_0 - 0.5 * (e_1 * p + e_2 * q + e_3 * r),
            back * e_1 + 0.5 * (e_0 * p + e_2 * r - e_3 * q),
            back * e_2 + 0.5 * (e_0 * q + e_3 * p - e_1 * r),
            back * e_3 + 0.5 * (e_0 * r + e_1 * q - e_2 * p),
            (half_span * (inputs[1] - inputs[3]) - gyration * q) / inertia,
            (half_span * (inputs[2] - inputs[0]) + gyration * p) / inertia,
            propeller_torque * spin / inertia_z,
        )

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        v_x, v_y, v_z = state[3:6]
        p, q, r = state[10:]
        mass, inertia, inertia_z = parameters[:3]
        drag, turn_drag, slow_speed, slow_rate = parameters[6:]
        speed = (v_x * v_x + v_y * v_y + v_z * v_z + slow_speed * slow_speed) ** 0.5
        rate = (p * p + q * q + r * r + slow_rate * slow_rate) ** 0.5
        slowing, braking = -drag * speed / mass, -turn_drag * rate
        return (
            slowing * v_x,
            slowing * v_y,
            slowing * v_z,
            braking * p / inertia,
            braking * q / inertia,
            braking * r / inertia_z,
        )
