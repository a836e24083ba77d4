"""Bodies that move in a plane: a car that slides, and a mass that a moving star pushes."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.systems.base import Array, Feature, System, identity, turn
from dopt.systems.elementary import cos, magnitude, sin
from dopt.types import Scalar


@dataclass(frozen=True, kw_only=True)
class Car(System):
    """Rigid body on a plane with one steered wheel in front and one behind, and a motor.

    State: position x, y [m] and heading ψ [rad] in the world, velocity vₓ (ahead), v_y (to the
    left) [m/s] and yaw rate r [rad/s] in the body's frame, steering angle δ [rad]. Inputs: commands
    of motor u₁ and steering u₂ [1].

    ẋ = vₓ cos ψ - v_y sin ψ, ẏ = vₓ sin ψ + v_y cos ψ, ψ̇ = r, δ̇ = (δₘ u₂ - δ)/τ,
    m (v̇ₓ - r v_y) = Fₘ u₁ - F₁ sin δ - ρ |vₓ| vₓ, m (v̇_y + r vₓ) = F₁ cos δ + F₂,
    I ṙ = a F₁ cos δ - b F₂,
    with the tyre forces Fᵢ = -Cᵢ wᵢ/√(|vᵢ|² + v₀²), wᵢ the part of the axle's velocity vᵢ across
    the wheel: w₁ = (v_y + a r) cos δ - vₓ sin δ, w₂ = v_y - b r. Far above v₀ a tyre's force is Cᵢ
    times the sine of its slip angle; it holds a standing car too, without a jump.
    Learned: the accelerations of tyres and drag. Known: motor, steering, and the turn of the frame.

    Source: the bicycle model of R. Rajamani, "Vehicle dynamics and control" (2012), chapter 2, with
    tyre forces that saturate.

    Parameters
    ----------
    mass : float
        m [kg].
    inertia : float
        I about the vertical through the centre of mass [kg m²].
    front, rear : float
        Distances a and b of the axles from the centre of mass [m].
    front_grip, rear_grip : float
        Largest forces C₁ and C₂ of the tyres [N].
    slip_speed : float
        v₀ [m/s].
    drag : float
        ρ [kg/m].
    motor : float
        Fₘ, force of the motor by its command [N].
    steering : float
        δₘ, steering angle by its command [rad].
    steering_time : float
        τ [s].

    Notes
    -----
    Reasons for the default values:

    - mass, inertia, front, rear: a model car, 30 cm from axle to axle.
    - grip: 8 N on each axle, half of the weight on it: a slippery floor.
    - motor: 10 N against a drag that holds it at 4.5 m/s.
    - gamma: commands of one: full drive, or full lock; both inputs share it.
    - dt: 0.02 s: at rest the tyres take 0.29 of a yaw rate in a step.
    - grid: what the car stays within for 95 % of the time under strong inputs of this energy,
      and more of sliding. The last axis is the steering angle up to full lock.
    """

    name: ClassVar[str] = "car"
    physical: ClassVar[tuple[str, ...]] = (
        *("mass", "inertia", "front", "rear", "front_grip", "rear_grip", "slip_speed", "drag"),
        *("motor", "steering", "steering_time"),
    )
    linear_parameters: ClassVar[tuple[str, ...]] = ("front_grip", "rear_grip", "drag")
    state_labels: ClassVar[tuple[str, ...]] = (
        *("x [m]", "y [m]", "ψ [rad]", "vₓ [m/s]", "v_y [m/s]", "r [rad/s]", "δ [rad]"),
    )
    input_labels: ClassVar[tuple[str, ...]] = ("u₁ [1]", "u₂ [1]")
    learned_rows: ClassVar[tuple[int, ...]] = (3, 4, 5)
    features: ClassVar[tuple[Feature, ...]] = (*identity(3, 4, 5), *turn(6))
    angle_indices: ClassVar[tuple[int, ...]] = (2, 6)
    phase_plane: ClassVar[tuple[int, int]] = (3, 4)
    grid_indices: ClassVar[tuple[int, ...]] = (3, 4, 5, 6)

    mass: float = parameter(3.0, "kg", "positive")
    inertia: float = parameter(0.05, "kg m²", "positive")
    front: float = parameter(0.15, "m", "positive")
    rear: float = parameter(0.15, "m", "positive")
    front_grip: float = parameter(8.0, "N", "nonnegative")
    rear_grip: float = parameter(8.0, "N", "nonnegative")
    slip_speed: float = parameter(0.5, "m/s", "positive")
    drag: float = parameter(0.5, "kg/m", "nonnegative")
    motor: float = parameter(10.0, "N", "positive")
    steering: float = parameter(0.6, "rad", "positive")
    steering_time: float = parameter(0.1, "s", "positive")
    gamma: float = parameter(1.0, "1", "positive")
    initial_state: tuple[float, ...] = parameter((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((2.5, 1.0, 3.0, 0.6), bound="positive")
    grid_points: tuple[int, ...] = parameter((6, 6, 6, 6), bound="positive")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        _, _, heading, ahead, left, turn, angle = state
        mass = parameters[0]
        motor, steering, steering_time = parameters[8:]
        return (
            ahead * cos(heading) - left * sin(heading),
            ahead * sin(heading) + left * cos(heading),
            turn,
            turn * left + motor * inputs[0] / mass,
            -turn * ahead,
            0.0 * turn,
            (steering * inputs[1] - angle) / steering_time,
        )

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        _, _, _, ahead, left, turn, angle = state
        mass, inertia, front, rear, front_grip, rear_grip, slip_speed, drag = parameters[:8]
        cosine, sine, slowest = cos(angle), sin(angle), slip_speed * slip_speed
        front_left, rear_left = left + front * turn, left - rear * turn
        across = front_left * cosine - ahead * sine
        force_1 = -front_grip * across / (ahead * ahead + front_left * front_left + slowest) ** 0.5
        force_2 = -rear_grip * rear_left / (ahead * ahead + rear_left * rear_left + slowest) ** 0.5
        return (
            -(force_1 * sine + drag * magnitude(ahead) * ahead) / mass,
            (force_1 * cosine + force_2) / mass,
            (front * force_1 * cosine - rear * force_2) / inertia,
        )


@dataclass(frozen=True, kw_only=True)
class MovingStar(System):
    """Point mass without inertia in a central force field whose centre circles about the origin.

    State: position x, y [m]. Inputs: force uₓ, u_y [N].

    α q̇ = F(q - c(t)) + u, with F(s) = A s / (√(|s|² + ε²) (1 + |s|²/ρ²)), a force away from the
    star that is largest about ε and falls to half of A at ρ, and c(t) = R (cos ωt, sin ωt).
    Learned: F/α. Known: u/α. The model is not told the time: centre and radius are what it is to
    follow (``model=grey_box``).

    Source: the star of Section 6.2 of M. Blanke and M. Lelarge, "FLEX: an adaptive exploration
    algorithm for nonlinear systems" (2023). Their mass has an inertia, and the friction α = 100 for
    steps of 0.01: by the Euler map its velocity then is dt (F + u), without a memory, and a step
    moves it by dt²(F + u). That is the map of this system with dt/α = 1e-4 s²/kg, one step later
    and with F where the mass was a step before.
    In their code a barrier of width 0.02 keeps the mass from the centre, where F has no direction;
    here ε makes F smooth there.

    Parameters
    ----------
    friction : float
        α [N s/m].
    strength : float
        A, largest force [N].
    radius : float
        ρ [m].
    core : float
        ε [m].
    orbit : float
        R [m].
    period : float
        2π/ω [s].

    Notes
    -----
    The default values come from its released code, with α = 100 and dt = 0.01 there and dt/α the
    same here:

    - gamma: an input moves the mass by 5 mm in a step; the star moves by 5.7 mm, and its force
      by 0.1 mm.
    - period: 1,000 steps, the horizon.
    - noise: of a force of 1e-4 N.
    - core: theirs is a barrier of this width.
    """

    name: ClassVar[str] = "moving_star"
    physical: ClassVar[tuple[str, ...]] = (
        *("friction", "strength", "radius", "core", "center_x", "center_y"),
    )
    linear_parameters: ClassVar[tuple[str, ...]] = ("strength",)
    state_labels: ClassVar[tuple[str, ...]] = ("x [m]", "y [m]")
    input_labels: ClassVar[tuple[str, ...]] = ("uₓ [N]", "u_y [N]")
    learned_rows: ClassVar[tuple[int, ...]] = (0, 1)
    features: ClassVar[tuple[Feature, ...]] = identity(0, 1)
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = (0, 1)

    friction: float = parameter(1.0, "N s/m", "positive")
    strength: float = parameter(1.0, "N", "nonnegative")
    radius: float = parameter(0.5, "m", "positive")
    core: float = parameter(0.02, "m", "positive")
    orbit: float = parameter(0.9, "m", "nonnegative")
    period: float = parameter(0.1, "s", "positive")
    gamma: float = parameter(50.0, "N", "positive")
    dt: float = parameter(1e-4, "s", "positive")
    noise: float = parameter(1e-6, bound="nonnegative")
    horizon: int = parameter(1000, "steps", "positive")
    initial_state: tuple[float, ...] = parameter((0.8, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((1.0, 1.0), bound="positive")
    grid_points: tuple[int, ...] = parameter((20, 20), bound="positive")

    @property
    def parameters(self) -> tuple[float, ...]:
        """Physical parameters in the order of ``physical``, with the centre at t = 0."""
        return self.friction, self.strength, self.radius, self.core, self.orbit, 0.0

    @functools.cached_property
    def history(self) -> Array:
        """Physical parameters of each step, (T, number of them)."""
        rows = np.tile(np.array(self.parameters), (self.horizon, 1))
        angle = 2.0 * math.pi / self.period * self.dt * np.arange(self.horizon)
        rows[:, self.physical.index("center_x")] = self.orbit * np.cos(angle)
        rows[:, self.physical.index("center_y")] = self.orbit * np.sin(angle)
        return rows

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:  # noqa: ARG004  # the input alone
        return inputs[0] / parameters[0], inputs[1] / parameters[0]

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        friction, strength, radius, core, center_x, center_y = parameters
        x, y = state[0] - center_x, state[1] - center_y
        square = x * x + y * y
        fall = (square + core * core) ** 0.5 * (1.0 + square / (radius * radius))
        factor = strength / (friction * fall)
        return factor * x, factor * y
