"""Row of n pendulums that springs couple, with a motor on the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from dopt.declare.validated_fields import Validated, parameter
from dopt.errors import SpecificationError
from dopt.systems.base import System
from dopt.systems.elementary import sin
from dopt.systems.features import Feature
from dopt.types import Scalar

LARGEST_ROW = 50
"""Pendulums of a row; each has a friction of its own, and the compiled equations hold them all."""

_DEFAULT_PENDULUMS = 5


def _shape(n: int) -> dict[str, tuple[object, ...]]:
    """Return what follows from the number of pendulums."""
    frictions = tuple(f"friction_{i}" for i in range(1, n + 1))
    rates = tuple(range(1, 2 * n, 2))
    return {
        "physical": ("gravity", "coupling", *frictions),
        "linear_parameters": frictions,
        "state_labels": tuple(
            label for i in range(1, n + 1) for label in (f"φ{i} [rad]", f"φ̇{i} [rad/s]")
        ),
        "learned_rows": rates,
        "features": tuple(Feature("identity", i) for i in rates),
        "angle_indices": tuple(range(0, 2 * n, 2)),
        "grid_indices": rates,
        "equilibrium": (0.0,) * (2 * n),
    }


_DEFAULT = _shape(_DEFAULT_PENDULUMS)


@dataclass(frozen=True, kw_only=True)
class CoupledPendulums(System):
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
    (:mod:`dopt.parameter_error`). The attributes of the class are those of the default number of
    pendulums.

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
        Of all 2n states and n rates, or those of one pendulum, which then hold for all.
    """

    name: ClassVar[str] = "coupled_pendulums"
    physical: ClassVar[tuple[str, ...]] = _DEFAULT["physical"]  # type: ignore[assignment]
    linear_parameters: ClassVar[tuple[str, ...]] = _DEFAULT["linear_parameters"]  # type: ignore[assignment]
    state_labels: ClassVar[tuple[str, ...]] = _DEFAULT["state_labels"]  # type: ignore[assignment]
    input_labels: ClassVar[tuple[str, ...]] = ("u [rad/s²]",)
    learned_rows: ClassVar[tuple[int, ...]] = _DEFAULT["learned_rows"]  # type: ignore[assignment]
    features: ClassVar[tuple[Feature, ...]] = _DEFAULT["features"]  # type: ignore[assignment]
    angle_indices: ClassVar[tuple[int, ...]] = _DEFAULT["angle_indices"]  # type: ignore[assignment]
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = _DEFAULT["grid_indices"]  # type: ignore[assignment]
    low_discrepancy: ClassVar[bool] = True
    equilibrium: ClassVar[tuple[float, ...] | None] = _DEFAULT["equilibrium"]  # type: ignore[assignment]

    n_pendulums: int = parameter(_DEFAULT_PENDULUMS, "pendulums", "positive")
    gravity: float = parameter(1.0, "rad/s²", "nonnegative")
    coupling: float = parameter(6.25, "1/s²", "nonnegative")
    friction: float = parameter(0.6, "1/s", "nonnegative")
    gamma: float = parameter(5.0, "rad/s²", "positive")
    noise: float = parameter(1e-5, bound="nonnegative")
    initial_state: tuple[float, ...] = parameter((0.0, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((3.0,), bound="positive")
    grid_points: tuple[int, ...] = parameter((64,), bound="positive")

    def __post_init__(self) -> None:
        Validated.__post_init__(self)
        n = self.n_pendulums
        if n > LARGEST_ROW:
            raise SpecificationError(
                f"env.n_pendulums is {n}, but it has to be at most {LARGEST_ROW}: set "
                f"env.n_pendulums to a smaller number."
            )
        for attribute, value in _shape(n).items():
            object.__setattr__(self, attribute, value)
        for field, size in (("initial_state", 2), ("grid_half_widths", 1)):
            given = getattr(self, field)
            if len(given) % size == 0 and given == given[:size] * (len(given) // size):
                object.__setattr__(self, field, given[:size] * n)
        super().__post_init__()

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
