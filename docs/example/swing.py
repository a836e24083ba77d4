"""A Gymnasium environment as a system: the pendulum of Gymnasium, explored as a black box."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from dopt.fields import parameter
from dopt.gymnasium import Environment
from dopt.systems import Feature


@dataclass(frozen=True, kw_only=True)
class Swing(Environment):
    """Pendulum-v1: what is learned is the pull of gravity, from transitions alone.

    State: angle θ from upright [rad], angular rate θ̇ [rad/s]. Input: torque u [N m], which is known
    to accelerate the rod of 1 kg and 1 m by 3 u / (m l²).
    """

    name: ClassVar[str] = "swing"
    state_labels: ClassVar[tuple[str, ...]] = ("θ [rad]", "θ̇ [rad/s]")
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

    id: str = parameter("Pendulum-v1")
    gamma: float = parameter(2.0, "N m", "positive")
    dt: float = parameter(0.05, "s", "positive")
    horizon: int = parameter(200, "steps", "positive")
    grid_half_widths: tuple[float, ...] = parameter((math.pi, 8.0), bound="positive")
    grid_points: tuple[int, ...] = parameter((32, 32), bound="positive")

    @staticmethod
    def known(
        state: Any,
        inputs: Any,
        parameters: Any,  # noqa: ARG004  # there are none
    ) -> tuple[Any, ...]:
        return state[1], 3.0 * inputs[0]

    @staticmethod
    def state(observation: Any) -> Sequence[float]:
        """Return θ and θ̇ of an observation of cos θ, sin θ and θ̇."""
        cosine, sine, rate = observation
        return math.atan2(sine, cosine), float(rate)
