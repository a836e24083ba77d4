"""A system and a policy of one's own: a boat that is pushed along a canal, and a staircase."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from dopt.fields import parameter
from dopt.policies.base import OpenLoop
from dopt.systems import Feature, System
from dopt.systems.elementary import magnitude


@dataclass(frozen=True, kw_only=True)
class Boat(System):
    """m v̇ = u - c₁ v - c₂ |v| v: what is learned is the drag of the water.

    State: position s [m], speed v [m/s]. Input: thrust u [N].
    """

    name: ClassVar[str] = "boat"
    physical: ClassVar[tuple[str, ...]] = ("mass", "linear_drag", "quadratic_drag")
    linear_parameters: ClassVar[tuple[str, ...]] = ("linear_drag", "quadratic_drag")
    state_labels: ClassVar[tuple[str, ...]] = ("s [m]", "v [m/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [N]",)
    learned_rows: ClassVar[tuple[int, ...]] = (1,)
    features: ClassVar[tuple[Feature, ...]] = (Feature("identity", 1),)
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = (1,)

    mass: float = parameter(2.0, "kg", "positive")
    linear_drag: float = parameter(0.5, "kg/s", "nonnegative")
    quadratic_drag: float = parameter(0.3, "kg/m", "nonnegative")
    gamma: float = parameter(4.0, "N", "positive")
    dt: float = parameter(0.05, "s", "positive")
    horizon: int = parameter(200, "steps", "positive")
    initial_state: tuple[float, ...] = parameter((0.0, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((3.0,), bound="positive")
    grid_points: tuple[int, ...] = parameter((64,), bound="positive")

    @staticmethod
    def known(state: Any, inputs: Any, parameters: Any) -> tuple[Any, ...]:
        return state[1], inputs[0] / parameters[0]

    @staticmethod
    def accelerations(state: Any, parameters: Any) -> tuple[Any, ...]:
        mass, linear, quadratic = parameters
        speed = state[1]
        return (-(linear + quadratic * magnitude(speed)) * speed / mass,)


@dataclass(frozen=True, kw_only=True)
class Staircase(OpenLoop):
    """u = γ, (1 - 2/(n-1)) γ, ..., -γ along the first input: n levels, each held as long."""

    name: ClassVar[str] = "staircase"

    levels: int = parameter(8, "levels", "positive")

    def inputs(
        self,
        system: System,
        rng: np.random.Generator,  # noqa: ARG002  # nothing is random here
    ) -> npt.NDArray[np.float64]:
        level = np.arange(system.horizon) * self.levels // system.horizon
        inputs = np.zeros((system.horizon, system.n_inputs))
        inputs[:, 0] = system.gamma * (1 - 2 * level / max(1, self.levels - 1))
        return inputs
