"""Four models of the DeepMind Control Suite.

Reference: Y. Tassa et al., "DeepMind Control Suite", arXiv 1801.00690 (2018).
"""

from __future__ import annotations

import importlib.util
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from dopt.declare.validated_fields import parameter
from dopt.systems.features import Feature
from dopt.systems.mujoco.engine import MuJoCo
from dopt.types import Scalar

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True, kw_only=True)
class SuiteModel(MuJoCo):
    """A model of the suite, which the package ``dm_control`` holds as a file.

    Attributes
    ----------
    file : str
        Name of the file.
    """

    file: ClassVar[str]

    @classmethod
    def load(cls) -> mujoco.MjModel:
        import mujoco

        found = importlib.util.find_spec("dm_control")  # its import takes a second: it also draws
        if found is None or not found.submodule_search_locations:
            raise ModuleNotFoundError("dm_control")
        folder = Path(found.submodule_search_locations[0]) / "suite"
        return mujoco.MjModel.from_xml_path(str(folder / cls.file))


@dataclass(frozen=True, kw_only=True)
class MuJoCoPendulum(SuiteModel):
    """Pendulum whose motor is too weak to lift it at once.

    State: angle θ from upright [rad], rate ω [rad/s]. Input: torque u [N m]. Learned: dω/dt.
    """

    name: ClassVar[str] = "mujoco_pendulum"
    file: ClassVar[str] = "pendulum.xml"
    start: ClassVar[tuple[float, ...]] = (math.pi,)
    state_labels: ClassVar[tuple[str, ...]] = ("θ [rad]", "ω [rad/s]")
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

    gamma: float = parameter(1.0, "N m", "positive")
    dt: float = parameter(0.02, "s", "positive")
    grid_half_widths: tuple[float, ...] = parameter((math.pi, 8.0), bound="positive")
    grid_points: tuple[int, ...] = parameter((32, 32), bound="positive")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:  # noqa: ARG004
        return state[1], 0.0 * state[1]


def _rates_of_two(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:  # noqa: ARG001
    return state[2], state[3], 0.0 * state[2], 0.0 * state[3]


@dataclass(frozen=True, kw_only=True)
class MuJoCoCartpole(SuiteModel):
    """Cart with a rod, pushed on a rail of ±1.8 m with soft stops.

    State: place y [m], angle φ from upright [rad], ẏ [m/s], φ̇ [rad/s]. Input: force u [10 N].
    Learned: ÿ and φ̈.
    """

    name: ClassVar[str] = "mujoco_cartpole"
    file: ClassVar[str] = "cartpole.xml"
    start: ClassVar[tuple[float, ...]] = (0.0, math.pi)
    state_labels: ClassVar[tuple[str, ...]] = ("y [m]", "φ [rad]", "ẏ [m/s]", "φ̇ [rad/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [10 N]",)
    learned_rows: ClassVar[tuple[int, ...]] = (2, 3)
    features: ClassVar[tuple[Feature, ...]] = (
        Feature("identity", 0),
        Feature("cos", 1),
        Feature("sin", 1),
        Feature("identity", 2),
        Feature("identity", 3),
    )
    angle_indices: ClassVar[tuple[int, ...]] = (1,)
    phase_plane: ClassVar[tuple[int, int]] = (1, 3)
    grid_indices: ClassVar[tuple[int, ...]] = (0, 1, 2, 3)

    gamma: float = parameter(0.3, "10 N", "positive")
    dt: float = parameter(0.01, "s", "positive")
    horizon: int = parameter(1000, "steps", "positive")
    grid_half_widths: tuple[float, ...] = parameter((1.5, math.pi, 2.0, 6.0), bound="positive")
    grid_points: tuple[int, ...] = parameter((4, 8, 6, 6), bound="positive")

    known = staticmethod(_rates_of_two)


@dataclass(frozen=True, kw_only=True)
class MuJoCoAcrobot(SuiteModel):
    """Two rods in a row, with a motor at the elbow alone.

    State: shoulder θ₁ from upright, elbow θ₂ [rad], their rates [rad/s]. Input: torque u [2 N m].
    Learned: both accelerations.
    """

    name: ClassVar[str] = "mujoco_acrobot"
    file: ClassVar[str] = "acrobot.xml"
    start: ClassVar[tuple[float, ...]] = (math.pi, 0.0)
    state_labels: ClassVar[tuple[str, ...]] = ("θ₁ [rad]", "θ₂ [rad]", "ω₁ [rad/s]", "ω₂ [rad/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [2 N m]",)
    learned_rows: ClassVar[tuple[int, ...]] = (2, 3)
    features: ClassVar[tuple[Feature, ...]] = (
        Feature("cos", 0),
        Feature("sin", 0),
        Feature("cos", 1),
        Feature("sin", 1),
        Feature("identity", 2),
        Feature("identity", 3),
    )
    angle_indices: ClassVar[tuple[int, ...]] = (0, 1)
    phase_plane: ClassVar[tuple[int, int]] = (0, 2)
    grid_indices: ClassVar[tuple[int, ...]] = (0, 1, 2, 3)

    gamma: float = parameter(1.0, "2 N m", "positive")
    dt: float = parameter(0.01, "s", "positive")
    horizon: int = parameter(1000, "steps", "positive")
    grid_half_widths: tuple[float, ...] = parameter((math.pi, math.pi, 3.0, 6.0), bound="positive")
    grid_points: tuple[int, ...] = parameter((6, 6, 6, 6), bound="positive")

    known = staticmethod(_rates_of_two)


@dataclass(frozen=True, kw_only=True)
class MuJoCoReacher(SuiteModel):
    """Two links in a plane without gravity, with a motor in each joint; the wrist has stops.

    State: shoulder θ₁, wrist θ₂ [rad], their rates [10 rad/s]. Input: torques u [0.05 N m].
    Learned: both accelerations. The links are light: in a step damping takes most of a velocity.
    """

    name: ClassVar[str] = "mujoco_reacher"
    file: ClassVar[str] = "reacher.xml"
    rate_unit: ClassVar[float] = 10.0
    start: ClassVar[tuple[float, ...]] = (0.0, 0.0)
    state_labels: ClassVar[tuple[str, ...]] = (
        "θ₁ [rad]",
        "θ₂ [rad]",
        "ω₁ [10 rad/s]",
        "ω₂ [10 rad/s]",
    )
    input_labels: ClassVar[tuple[str, ...]] = ("u₁ [0.05 N m]", "u₂ [0.05 N m]")
    learned_rows: ClassVar[tuple[int, ...]] = (2, 3)
    features: ClassVar[tuple[Feature, ...]] = (
        Feature("cos", 1),
        Feature("sin", 1),
        Feature("identity", 2),
        Feature("identity", 3),
    )
    angle_indices: ClassVar[tuple[int, ...]] = (0, 1)
    phase_plane: ClassVar[tuple[int, int]] = (1, 3)
    grid_indices: ClassVar[tuple[int, ...]] = (1, 2, 3)

    gamma: float = parameter(1.0, "0.05 N m", "positive")
    dt: float = parameter(0.02, "s", "positive")
    grid_half_widths: tuple[float, ...] = parameter((2.0, 0.2, 0.4), bound="positive")
    grid_points: tuple[int, ...] = parameter((10, 10, 10), bound="positive")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:  # noqa: ARG004
        return 10.0 * state[2], 10.0 * state[3], 0.0 * state[2], 0.0 * state[3]
