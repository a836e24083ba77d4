"""Van der Pol oscillator with an input."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.declare.validated_fields import parameter
from dopt.systems.base import System
from dopt.systems.features import Feature
from dopt.types import Scalar


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
    """

    name: ClassVar[str] = "van_der_pol"
    physical: ClassVar[tuple[str, ...]] = ("damping", "amplitude", "stiffness")
    linear_parameters: ClassVar[tuple[str, ...]] = ("damping",)
    state_labels: ClassVar[tuple[str, ...]] = ("q [m]", "v [m/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [m/s²]",)
    learned_rows: ClassVar[tuple[int, ...]] = (1,)
    features: ClassVar[tuple[Feature, ...]] = (Feature("identity", 0), Feature("identity", 1))
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
