"""Oscillators: two masses between springs, and the oscillator of Van der Pol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.fields import parameter
from dopt.systems.base import Feature, System, identity
from dopt.types import Scalar


@dataclass(frozen=True, kw_only=True)
class MassSpring(System):
    """Chain wall - mass - mass - wall of equal springs and dampers, with a force on each mass.

    State: displacements q₁, q₂ from rest [m], each with its velocity [m/s]. Inputs: u₁, u₂ [N].

    m q̈₁ = -k (2 q₁ - q₂) - c (2 q̇₁ - q̇₂) + u₁ and the same with 1 and 2 exchanged. Learned: both
    accelerations at u = 0. Known: u / m. Modes: in phase, ω² = k/m, and opposed, ω² = 3 k/m.

    Parameters
    ----------
    mass : float
        Each of both masses m [kg].
    stiffness : float
        Of each spring, k [N/m].
    damping : float
        Of each damper, c [N s/m].

    Notes
    -----
    Reasons for the default values:

    - gamma: 5 N against springs of 10 N/m: displacements of half a metre at rest, and about two
      metres at resonance.
    - damping: both modes oscillate (3.2 and 5.4 rad/s) and die out within some periods.
    - dt: 0.02 s: the Euler map has the spectral radius 0.997 at rest.
    - grid: what the masses stay within for 95 % of the time under strong inputs of this energy
      (held random, square waves about the eigenfrequency, one of rising frequency).
    - horizon: 10 s, about five periods.
    """

    name: ClassVar[str] = "mass_spring"
    physical: ClassVar[tuple[str, ...]] = ("mass", "stiffness", "damping")
    linear_parameters: ClassVar[tuple[str, ...]] = ("stiffness", "damping")
    state_labels: ClassVar[tuple[str, ...]] = ("q₁ [m]", "q̇₁ [m/s]", "q₂ [m]", "q̇₂ [m/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u₁ [N]", "u₂ [N]")
    learned_rows: ClassVar[tuple[int, ...]] = (1, 3)
    features: ClassVar[tuple[Feature, ...]] = identity(0, 1, 2, 3)
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = (0, 1, 2, 3)
    equilibrium: ClassVar[tuple[float, ...] | None] = (0.0, 0.0, 0.0, 0.0)

    mass: float = parameter(1.0, "kg", "positive")
    stiffness: float = parameter(10.0, "N/m", "nonnegative")
    damping: float = parameter(0.5, "N s/m", "nonnegative")
    gamma: float = parameter(5.0, "N", "positive")
    initial_state: tuple[float, ...] = parameter((0.0, 0.0, 0.0, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((1.9, 6.0, 1.9, 6.0), bound="positive")
    grid_points: tuple[int, ...] = parameter((6, 6, 6, 6), bound="positive")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        mass, _, _ = parameters
        return state[1], inputs[0] / mass, state[3], inputs[1] / mass

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        mass, stiffness, damping = parameters
        position_1, rate_1, position_2, rate_2 = state
        force_1 = stiffness * (2.0 * position_1 - position_2) + damping * (2.0 * rate_1 - rate_2)
        force_2 = stiffness * (2.0 * position_2 - position_1) + damping * (2.0 * rate_2 - rate_1)
        return -force_1 / mass, -force_2 / mass


@dataclass(frozen=True, kw_only=True)
class VanDerPol(System):
    """Oscillator whose damping feeds small motions and brakes large ones.

    State: displacement q [m], velocity v [m/s]. Input: force by mass, u [m/s²].

    dv/dt = μ (1 - q²/a²) v - ω₀² q + u. Learned: the acceleration of the damping. Known: the spring
    and the input. Without inputs all motions tend to one cycle of amplitude 2a; rest is unstable,
    so that there is no mode for periodic inputs.

    Source: B. van der Pol, "On relaxation-oscillations", Philosophical Magazine 2 (1926).

    Parameters
    ----------
    damping : float
        μ, rate at which motions about rest grow [1/s].
    amplitude : float
        a, displacement beyond which the damping brakes [m].
    stiffness : float
        ω₀², stiffness of the spring by mass [1/s²].

    Notes
    -----
    Reasons for the default values:

    - damping, amplitude, stiffness: one each, the textbook's oscillator, with a cycle of 6.7 s
      and 2 m.
    - gamma: twice what holds the spring at a: the motion can be stopped and driven beyond the
      cycle.
    - dt: 0.05 s: where the damping brakes most, at the corners of the grid, it takes 0.34 of a
      rate in a step.
    - grid: what the mass stays within under strong inputs of this energy.
    - horizon: 25 s, about four cycles.
    """

    name: ClassVar[str] = "van_der_pol"
    physical: ClassVar[tuple[str, ...]] = ("damping", "amplitude", "stiffness")
    linear_parameters: ClassVar[tuple[str, ...]] = ("damping",)
    state_labels: ClassVar[tuple[str, ...]] = ("q [m]", "v [m/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [m/s²]",)
    learned_rows: ClassVar[tuple[int, ...]] = (1,)
    features: ClassVar[tuple[Feature, ...]] = identity(0, 1)
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = (0, 1)

    damping: float = parameter(1.0, "1/s", "nonnegative")
    amplitude: float = parameter(1.0, "m", "positive")
    stiffness: float = parameter(1.0, "1/s²", "nonnegative")
    gamma: float = parameter(2.0, "m/s²", "positive")
    dt: float = parameter(0.05, "s", "positive")
    initial_state: tuple[float, ...] = parameter((0.01, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((2.8, 4.5), bound="positive")
    grid_points: tuple[int, ...] = parameter((32, 32), bound="positive")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        return state[1], inputs[0] - parameters[2] * state[0]

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        displacement, velocity = state
        damping, amplitude, _ = parameters
        share = displacement / amplitude
        return (damping * (1.0 - share * share) * velocity,)
