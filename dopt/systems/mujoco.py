"""Models of the physics engine MuJoCo as black boxes whose truth is known (extra ``mujoco``).

Four of them are models of the DeepMind Control Suite: Y. Tassa et al., "DeepMind Control Suite",
arXiv 1801.00690 (2018).
"""

from __future__ import annotations

import functools
import importlib.util
import logging
import math
from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from dopt.errors import SpecificationError, install_command
from dopt.fields import parameter
from dopt.systems.base import Array, Feature, identity, turn
from dopt.systems.black_box import BlackBox, Episode, check_amplitude, check_step
from dopt.types import Scalar

if TYPE_CHECKING:
    import mujoco

_log = logging.getLogger(__name__)

MISSING = f"needs MuJoCo, which is not installed: {install_command('mujoco')}."

UNLIMITED = 1e10
"""Range of an actuator that has none."""


@dataclass(frozen=True, kw_only=True)
class MuJoCo(BlackBox):
    """A model of MuJoCo whose joints slide or turn about one axis.

    State: the n positions of the joints, then their n velocities, in the units of the engine.
    Input: the controls of the actuators, cut to their ranges. Learned: the n accelerations with all
    effects of the inputs; known: that a position changes by its velocity.

    An acceleration is the change of a velocity over one step of the engine, divided by dt. It is
    what a trial observes, and the truth at a state of one's choice. The acceleration that
    ``mj_forward`` gives is that at the beginning of the step: it differs where the engine's
    integrator takes damping implicitly, and where a joint meets its limit within the step.

    A subclass declares names, learned rows, features and the known part as every system does, the
    positions at which a trial starts, and :meth:`load`. ``dt`` has to be the time step of the
    model, and γ within the ranges of its actuators.

    Attributes
    ----------
    start : tuple of float
        Positions of the joints about which a trial starts, (n,).
    rate_unit : float
        Unit of the velocities in the engine's unit, chosen so that the accelerations are of a size
        that a network learns (:data:`dopt.spec.custom_system.LARGEST`).

    Parameters
    ----------
    start_spread : float
        Standard deviation of the positions at the start, which the seed draws; velocities are 0.
    """

    reads_inputs: ClassVar[bool] = True
    start: ClassVar[tuple[float, ...]]
    rate_unit: ClassVar[float] = 1.0

    start_spread: float = parameter(0.01, bound="nonnegative")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.integrator != "euler":
            raise SpecificationError(
                f"env.integrator is '{self.integrator}', but the accelerations of {self.name} are "
                f"means over a step of MuJoCo: set it to euler."
            )

    @classmethod
    @abstractmethod
    def load(cls) -> mujoco.MjModel:
        """Return the model."""

    def episode(self, seed: int) -> Episode:
        """Start a run; see :class:`BlackBox`.

        Raises
        ------
        SpecificationError
            If MuJoCo is not installed, or the model is not what was declared.
        """
        drawn = np.random.default_rng(seed).standard_normal(self.n_states // 2)
        positions = np.array(self.start) + self.start_spread * drawn
        return Run(_checked_model(self), positions, self.rate_unit)

    def true_accelerations(self, states: Array, inputs: Array) -> Array:
        run = Run(_checked_model(self), np.array(self.start), self.rate_unit)
        following = [run.step_from(x, u) for x, u in zip(states, inputs, strict=True)]
        return self.less_known(np.array(following) - states, states, inputs)


class Run:
    """A run of a model from positions of its joints, (n,), at rest."""

    def __init__(self, model: mujoco.MjModel, positions: Array, rate_unit: float) -> None:
        import mujoco

        self._model, self._data = model, mujoco.MjData(model)
        self._advance, self._reset = mujoco.mj_step, mujoco.mj_resetData
        self._low, self._high = _range_of_controls(model)
        self._control, self._rate_unit = self._data.ctrl, rate_unit
        self._positions, self._velocities = self._data.qpos, self._data.qvel
        kinds = mujoco.mjtWarning
        bad = (
            *(kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC),
            kinds.mjWARN_BADCTRL,  # of an input that is NaN, in place of which it takes 0
        )
        self._warnings = [self._data.warning[kind] for kind in bad]
        self._positions[:] = positions

    @property
    def state(self) -> Array:
        """State, (2 n,); NaN once the engine has restarted because numbers exploded."""
        if any(warning.number for warning in self._warnings):
            return np.full(2 * len(self._velocities), np.nan)
        return np.concatenate([self._positions, self._velocities / self._rate_unit])

    def step(self, inputs: Array) -> Array:
        """Apply an input, (m,), within the ranges of the actuators, and return it."""
        applied: Array = np.clip(inputs, self._low, self._high)
        self._control[:] = applied
        self._advance(self._model, self._data)
        return applied

    def step_from(self, state: Array, inputs: Array) -> Array:
        """Apply an input, (m,), at a state, (2 n,), and return the state that follows, (2 n,).

        The steps before make no difference.
        """
        self._reset(self._model, self._data)
        n = len(self._velocities)
        self._positions[:], self._velocities[:] = state[:n], self._rate_unit * state[n:]
        self.step(inputs)
        return self.state


@functools.lru_cache(maxsize=16)
def _checked_model(system: MuJoCo) -> mujoco.MjModel:
    """Return the model of a system, or raise SpecificationError if it is not as declared."""
    try:
        log_warnings()
        model = type(system).load()
    except ModuleNotFoundError as error:
        raise SpecificationError(f"env '{system.name}' {MISSING}") from error
    n, name = system.n_states // 2, system.name
    if (model.nq, model.nv, model.nu) != (n, n, system.n_inputs) or system.n_states != 2 * n:
        raise SpecificationError(
            f"the model of env '{name}' has {model.nq} positions, {model.nv} velocities and "
            f"{model.nu} actuators, but {system.n_states} states and {system.n_inputs} inputs are "
            f"declared: declare each position, then each velocity, of joints that slide or turn "
            f"about one axis."
        )
    check_step(system, model.opt.timestep, f"the model of '{name}'")
    check_amplitude(system, *_range_of_controls(model), f"actuators of '{name}'")
    return model


def log_warnings() -> None:
    """Have the engine's warnings logged: it would write a file into the working folder."""
    import mujoco

    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(lambda text: _log.info("MuJoCo warns: %s", text))


def _range_of_controls(model: mujoco.MjModel) -> tuple[Array, Array]:
    """Return the least and the largest controls, (m,) each."""
    limited = model.actuator_ctrllimited.astype(bool)
    ranges = np.where(limited[:, None], model.actuator_ctrlrange, [-UNLIMITED, UNLIMITED])
    return ranges[:, 0].copy(), ranges[:, 1].copy()


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

    Notes
    -----
    It takes ``model=affine`` or ``model=black_box``. Reasons for the default values:

    - gamma: 1 N m, all that the motor has: a fifth of the torque that holds the weight level.
    - grid: the full circle, and 8 rad/s: a fall from upright ends with 8.9 rad/s, less the
      friction.
    - horizon: 10 s.
    """

    name: ClassVar[str] = "mujoco_pendulum"
    file: ClassVar[str] = "pendulum.xml"
    start: ClassVar[tuple[float, ...]] = (math.pi,)
    state_labels: ClassVar[tuple[str, ...]] = ("θ [rad]", "ω [rad/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [N m]",)
    learned_rows: ClassVar[tuple[int, ...]] = (1,)
    features: ClassVar[tuple[Feature, ...]] = (*turn(0), *identity(1))
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

    Notes
    -----
    It takes ``model=affine`` or ``model=black_box``. Reasons for the default values:

    - gamma: 3 N of the 10 N that the motor has: with all of it the cart is at a stop after
      0.6 s.
    - grid: within the stops at 1.8 m, the full circle.
    - horizon: 10 s, an episode of the suite.
    """

    name: ClassVar[str] = "mujoco_cartpole"
    file: ClassVar[str] = "cartpole.xml"
    start: ClassVar[tuple[float, ...]] = (0.0, math.pi)
    state_labels: ClassVar[tuple[str, ...]] = ("y [m]", "φ [rad]", "ẏ [m/s]", "φ̇ [rad/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [10 N]",)
    learned_rows: ClassVar[tuple[int, ...]] = (2, 3)
    features: ClassVar[tuple[Feature, ...]] = (*identity(0), *turn(1), *identity(2, 3))
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

    Notes
    -----
    It takes ``model=affine`` or ``model=black_box``. Reasons for the default values:

    - gamma: all that the motor has, 2 N m.
    - grid: both full circles.
    - horizon: 10 s, an episode of the suite.
    """

    name: ClassVar[str] = "mujoco_acrobot"
    file: ClassVar[str] = "acrobot.xml"
    start: ClassVar[tuple[float, ...]] = (math.pi, 0.0)
    state_labels: ClassVar[tuple[str, ...]] = ("θ₁ [rad]", "θ₂ [rad]", "ω₁ [rad/s]", "ω₂ [rad/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [2 N m]",)
    learned_rows: ClassVar[tuple[int, ...]] = (2, 3)
    features: ClassVar[tuple[Feature, ...]] = (*turn(0), *turn(1), *identity(2, 3))
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

    Notes
    -----
    It takes ``model=affine`` or ``model=black_box``. Reasons for the default values:

    - gamma: all that each motor has, 0.05 N m.
    - grid: wrist within its stops at 2.8 rad; rates that the joints reach under full torque.
    - horizon: 10 s.
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
    features: ClassVar[tuple[Feature, ...]] = (*turn(1), *identity(2, 3))
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


__all__ = [
    "MuJoCo",
    "MuJoCoAcrobot",
    "MuJoCoCartpole",
    "MuJoCoPendulum",
    "MuJoCoReacher",
    "log_warnings",
]
