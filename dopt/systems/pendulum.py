"""Pendulums: one, one that wears out, a disk with a weight, and a row that springs couple."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.systems.base import Array, Feature, Repeated, System, identity, turn
from dopt.systems.elementary import sin, tanh
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
    features: ClassVar[tuple[Feature, ...]] = (*turn(0), *identity(1))
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

    Notes
    -----
    It takes ``model=affine`` or ``model=black_box``.
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


@dataclass(frozen=True, kw_only=True)
class DriftingPendulum(Pendulum):
    """The pendulum with a friction that tends to another value, b(t) = b∞ + (b₀ - b∞) exp(-t/τ).

    The model is not told the time. The loss of step t is that against the accelerations at the time
    t dt of the step.

    Parameters
    ----------
    friction : float
        Viscous friction coefficient b₀ of the pivot at t = 0 [N m s].
    final_friction : float
        Coefficient b∞ of the worn pivot [N m s].
    time_constant : float
        τ [s].

    Notes
    -----
    Reasons for the default values beside the reasons of env=pendulum:

    - friction: b/I grows from 0.5 1/s to 1.5 1/s. A model of the first second is then wrong by
      4.5 rad/s² (root mean square over the grid), 40 % of the accelerations themselves.
    - time: constant of 5 s: the friction is where it tends to, to 2 %, at the end of the
      horizon.
    - horizon: 20 s, twice as long as in env=pendulum.
    """

    name: ClassVar[str] = "drifting_pendulum"

    horizon: int = parameter(1000, "steps", "positive")
    final_friction: float = parameter(0.5, "N m s", "nonnegative")
    time_constant: float = parameter(5.0, "s", "positive")

    @functools.cached_property
    def history(self) -> Array:
        """Physical parameters of each step, (T, number of them)."""
        rows = np.tile(np.array(self.parameters), (self.horizon, 1))
        worn = -np.expm1(-self.dt * np.arange(self.horizon) / self.time_constant)
        growth = (self.final_friction - self.friction) * worn
        rows[:, self.physical.index("friction")] += growth
        return rows


@dataclass(frozen=True, kw_only=True)
class UnbalancedDisk(System):
    """Disk with a weight off its centre, turned by a voltage.

    State: angle y from hanging [rad], rate ω [rad/s]. Input: voltage u [V].

    dω/dt = -ω₀² sin y - b ω - c tanh(ω / ω_c) + k u. Learned: dω/dt at u = 0. Known: k u.

    The numbers describe the laboratory's disk that exercises of system identification simulate.
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

    Notes
    -----
    Reasons for the default values:

    - gravity, friction, dry_friction, motor_gain: of the laboratory's disk.
    - gamma: 3 V is 66 % of the voltage that holds the weight level: swinging up takes a few
      swings.
    - dt: 0.01 s: the Euler map follows the dry friction where it turns sign (dt c / ω_c = 0.6).
    - grid: the full circle, and 20 rad/s: a fall from upright ends with 22 rad/s, less the
      friction.
    - horizon: 5 s, about nine periods.
    """

    name: ClassVar[str] = "unbalanced_disk"
    physical: ClassVar[tuple[str, ...]] = (
        *("gravity", "friction", "dry_friction", "dry_rate", "motor_gain"),
    )
    linear_parameters: ClassVar[tuple[str, ...]] = ("gravity", "friction", "dry_friction")
    state_labels: ClassVar[tuple[str, ...]] = ("y [rad]", "ω [rad/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [V]",)
    learned_rows: ClassVar[tuple[int, ...]] = (1,)
    features: ClassVar[tuple[Feature, ...]] = (*turn(0), *identity(1))
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


@dataclass(frozen=True, kw_only=True)
class CoupledPendulums(Repeated):
    """Row of n equal pendulums on one axis, each coupled to its neighbours by torsion springs.

    State: φ₁, φ̇₁, …, φₙ, φ̇ₙ, angles from hanging [rad] and rates [rad/s]. Input: the torque of
    the only motor, on the first pendulum, by its moment of inertia [rad/s²].

    φ̈ᵢ = -ω₀² sin φᵢ - κ Σⱼ (φᵢ - φⱼ) - bᵢ φ̇ᵢ + δᵢ₁ u, with j over the one or two neighbours.
    Learned: the accelerations of friction, -bᵢ φ̇ᵢ. Known: all other terms. The linear model has the
    n frictions for its parameters.

    Source: Table 3 of M. Blanke and M. Lelarge, "FLEX: an adaptive exploration algorithm for
    nonlinear systems" (2023). It prints no equation and no constants: those here are this
    project's.

    The evaluation box has an axis for each rate, and its points are a low-discrepancy set, whose
    projection on every axis is a regular partition: the loss of the linear model is the Euclidean
    norm of the error of the frictions times the root mean square of that partition
    (:mod:`dopt.assessment`).

    Parameters
    ----------
    n_pendulums : int
        Number n of pendulums.
    gravity : float
        ω₀², gravity by length [rad/s²].
    coupling : float
        κ, stiffness of a spring by the moment of inertia [1/s²].
    friction : float
        True viscous friction of every pendulum by the moment of inertia [1/s]; a model learns it
        for each.
    initial_state, grid_half_widths : tuple of float
        Of all 2n states and n rates, or of one pendulum, which then hold for all.

    Notes
    -----
    Reasons for the default values:

    - coupling: 6.25 / s²: a wave passes about two pendulums in a second.
    - friction: 0.6 / s: all modes die out, and the Euler map with dt = 0.02 s has a spectral
      radius below 1 at rest for any number of pendulums, which takes dt (ω₀² + 4 κ) = 0.52 / s
      at least.
    - gamma: 5 rad/s², five times what holds a pendulum level.
    - noise: so small that the wave's way along the row decides how many samples the last
      friction takes.

    One number of grid_half_widths and a pair of initial_state stand for all pendulums.
    """

    name: ClassVar[str] = "coupled_pendulums"
    input_labels: ClassVar[tuple[str, ...]] = ("u [rad/s²]",)
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    low_discrepancy: ClassVar[bool] = True
    counted: ClassVar[str] = "n_pendulums"
    most: ClassVar[int] = 50  # each has its friction, and the compiled equations hold them all
    repeated: ClassVar[dict[str, int]] = {"initial_state": 2, "grid_half_widths": 1}

    n_pendulums: int = parameter(5, "pendulums", "positive")
    gravity: float = parameter(1.0, "rad/s²", "nonnegative")
    coupling: float = parameter(6.25, "1/s²", "nonnegative")
    friction: float = parameter(0.6, "1/s", "nonnegative")
    gamma: float = parameter(5.0, "rad/s²", "positive")
    noise: float = parameter(1e-5, bound="nonnegative")
    initial_state: tuple[float, ...] = parameter((0.0, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((3.0,), bound="positive")
    grid_points: tuple[int, ...] = parameter((64,), bound="positive")

    @staticmethod
    def shape(n: int) -> dict[str, tuple[object, ...]]:
        pendulums, rates = range(1, n + 1), range(1, 2 * n, 2)
        frictions = tuple(f"friction_{i}" for i in pendulums)
        return {
            "physical": ("gravity", "coupling", *frictions),
            "linear_parameters": frictions,
            "state_labels": tuple(x for i in pendulums for x in (f"φ{i} [rad]", f"φ̇{i} [rad/s]")),
            "learned_rows": tuple(rates),
            "features": identity(*rates),
            "angle_indices": tuple(range(0, 2 * n, 2)),
            "grid_indices": tuple(rates),
            "equilibrium": (0.0,) * (2 * n),
        }

    @property
    def parameters(self) -> tuple[float, ...]:
        """Physical parameters in the order of ``physical``."""
        return (self.gravity, self.coupling, *[self.friction] * self.n_pendulums)

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> Sequence[Scalar]:
        gravity, coupling, n = parameters[0], parameters[1], len(state) // 2
        flow = []
        for i in range(n):
            angle = state[2 * i]
            acceleration = -gravity * sin(angle)
            if i > 0:
                acceleration = acceleration - coupling * (angle - state[2 * i - 2])
            if i < n - 1:
                acceleration = acceleration - coupling * (angle - state[2 * i + 2])
            if i == 0:
                acceleration = acceleration + inputs[0]
            flow.append(state[2 * i + 1])
            flow.append(acceleration)
        return flow

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> Sequence[Scalar]:
        rows = []
        for i in range(len(state) // 2):
            rows.append(-parameters[2 + i] * state[2 * i + 1])  # noqa: PERF401  # Numba's lists
        return rows
