"""Damped two-link robot arm in a vertical plane, with point masses at the ends of the links."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.declare.validated_fields import parameter
from dopt.systems.base import System
from dopt.systems.elementary import cos, sin
from dopt.systems.features import Feature
from dopt.types import Scalar


def _solved(
    state: Scalar, parameters: Scalar, right_1: Scalar, right_2: Scalar
) -> tuple[Scalar, Scalar]:
    """Return H(φ)⁻¹ (right_1, right_2) with the mass matrix H of the arm."""
    mass_1, mass_2, length_1, length_2, _, _ = parameters
    diagonal_1 = (mass_1 + mass_2) * length_1**2
    diagonal_2 = mass_2 * length_2**2
    coupling = mass_2 * length_1 * length_2 * cos(state[0] - state[2])
    determinant = diagonal_1 * diagonal_2 - coupling**2
    first = (diagonal_2 * right_1 - coupling * right_2) / determinant
    second = (diagonal_1 * right_2 - coupling * right_1) / determinant
    return first, second


@dataclass(frozen=True, kw_only=True)
class Arm(System):
    """Double pendulum with viscous friction, driven by generalised torques on both links.

    State: φ₁, φ̇₁, φ₂, φ̇₂, absolute angles from hanging [rad] and rates [rad/s]. Inputs: u₁, u₂
    [N m], conjugate to the absolute angles.

    H φ̈ + c + g = u - α φ̇ with H = [[(m₁+m₂) l₁², m₂ l₁ l₂ cos δ], [·, m₂ l₂²]],
    c = m₂ l₁ l₂ sin δ (φ̇₂², -φ̇₁²), g = ((m₁+m₂) g l₁ sin φ₁, m₂ g l₂ sin φ₂), δ = φ₁ - φ₂.
    Learned: φ̈₁ and φ̈₂ at u = 0. Known: H⁻¹ u.

    Parameters
    ----------
    mass_1, mass_2 : float
        Point masses m₁, m₂ [kg].
    length_1, length_2 : float
        Lengths l₁, l₂ of the links [m].
    gravity : float
        Gravitational acceleration g [m/s²].
    friction : float
        Viscous friction coefficient α of both angles [N m s].
    """

    name: ClassVar[str] = "arm"
    physical: ClassVar[tuple[str, ...]] = (
        "mass_1",
        "mass_2",
        "length_1",
        "length_2",
        "gravity",
        "friction",
    )
    linear_parameters: ClassVar[tuple[str, ...]] = ("gravity", "friction")
    state_labels: ClassVar[tuple[str, ...]] = ("φ₁ [rad]", "φ̇₁ [rad/s]", "φ₂ [rad]", "φ̇₂ [rad/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u₁ [N m]", "u₂ [N m]")
    learned_rows: ClassVar[tuple[int, ...]] = (1, 3)
    features: ClassVar[tuple[Feature, ...]] = (
        Feature("cos", 0),
        Feature("sin", 0),
        Feature("identity", 1),
        Feature("cos", 2),
        Feature("sin", 2),
        Feature("identity", 3),
    )
    angle_indices: ClassVar[tuple[int, ...]] = (0, 2)
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = (0, 1, 2, 3)
    equilibrium: ClassVar[tuple[float, ...] | None] = (0.0, 0.0, 0.0, 0.0)

    mass_1: float = parameter(1.0, "kg", "positive")
    mass_2: float = parameter(1.0, "kg", "positive")
    length_1: float = parameter(1.0, "m", "positive")
    length_2: float = parameter(1.0, "m", "positive")
    gravity: float = parameter(10.0, "m/s²", "nonnegative")
    friction: float = parameter(2.0, "N m s", "nonnegative")
    gamma: float = parameter(5.0, "N m", "positive")
    initial_state: tuple[float, ...] = parameter((0.0, 0.0, 0.0, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((0.65, 1.6, 1.0, 2.3), bound="positive")
    grid_points: tuple[int, ...] = parameter((6, 6, 6, 6), bound="positive")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        first, second = _solved(state, parameters, inputs[0], inputs[1])
        return state[1], first, state[3], second

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        mass_1, mass_2, length_1, length_2, gravity, friction = parameters
        angle_1, rate_1, angle_2, rate_2 = state
        twist = mass_2 * length_1 * length_2 * sin(angle_1 - angle_2)
        weight_1 = (mass_1 + mass_2) * gravity * length_1 * sin(angle_1)
        weight_2 = mass_2 * gravity * length_2 * sin(angle_2)
        torque_1 = -friction * rate_1 - twist * rate_2**2 - weight_1
        torque_2 = -friction * rate_2 + twist * rate_1**2 - weight_2
        return _solved(state, parameters, torque_1, torque_2)
