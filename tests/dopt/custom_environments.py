"""Environments of Gymnasium, well-behaved and rough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

from dopt.fields import parameter
from dopt.gymnasium import Environment
from dopt.learning.base import CustomLearner, Updater
from dopt.systems import Feature, System
from dopt.trial_view import TrialView

DRAG = 0.7
"""Of the point mass, v̇ = u - DRAG v, by the Euler map."""

WALL = 1.5
"""Distance at which it hits a wall, and its episode ends."""


class PointEnv(gymnasium.Env):
    """One axis, or two; observed in single precision as (x, v)."""

    dt = 0.1

    def __init__(self, n: int = 1, wall: float = WALL, actions: str = "box") -> None:
        self.n, self.wall = n, wall
        self.action_space = Box(-2.0, 2.0, (n,)) if actions == "box" else Discrete(3)
        self.observation_space = Box(-np.inf, np.inf, (2 * n,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self.place = self.np_random.uniform(-0.1, 0.1, self.n)
        self.speed = np.zeros(self.n)
        return np.concatenate([self.place, self.speed]), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action)
        change = action - DRAG * self.speed
        self.place = self.place + self.dt * self.speed
        self.speed = self.speed + self.dt * change
        hit = bool(np.any(np.abs(self.place) > self.wall))
        return np.concatenate([self.place, self.speed]), 0.0, hit, False, {}


def register(
    kind: type[gymnasium.Env], identity: str = "", most: int | None = None, **settings: Any
) -> None:
    """Register an environment, by the name of its class or another, with its most steps."""
    identity = f"dopt_tests/{identity or kind.__name__}-v0"
    if identity not in gymnasium.registry:
        gymnasium.register(identity, kind, kwargs=settings, max_episode_steps=most)


register(PointEnv, "Point", 7, wall=1e9)
register(PointEnv, "Walled", 7)
register(PointEnv, "Buttons", 7, actions="discrete")


@dataclass(frozen=True, kw_only=True)
class Point(Environment):
    name: ClassVar[str] = "point"
    state_labels: ClassVar[tuple[str, ...]] = ("x [m]", "v [m/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [m/s²]",)
    learned_rows: ClassVar[tuple[int, ...]] = (1,)
    features: ClassVar[tuple[Feature, ...]] = (Feature("identity", 1),)
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = (1,)

    id: str = parameter("dopt_tests/Point-v0")
    gamma: float = parameter(2.0, bound="positive")
    dt: float = parameter(0.1, "s", "positive")
    horizon: int = parameter(30, "steps", "positive")
    grid_half_widths: tuple[float, ...] = parameter((2.0,), bound="positive")
    grid_points: tuple[int, ...] = parameter((50,), bound="positive")

    @staticmethod
    def known(state: Any, inputs: Any, parameters: Any) -> tuple[Any, ...]:  # noqa: ARG004
        return state[1], inputs[0]

    @staticmethod
    def state(observation: Any) -> Sequence[float]:
        return tuple(observation)


@dataclass(frozen=True, kw_only=True)
class Interpreted(Point):
    """Has a known part that does not compile, and says so."""

    name: ClassVar[str] = "interpreted"
    compiled: ClassVar[bool] = False

    @staticmethod
    def known(state: Any, inputs: Any, parameters: Any) -> tuple[Any, ...]:
        return tuple(getattr(Point, "known")(state, inputs, parameters))  # noqa: B009


@dataclass(frozen=True, kw_only=True)
class Mistaken(Interpreted):
    """Says that it does."""

    name: ClassVar[str] = "mistaken"
    compiled: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class Blurred(Point):
    """Forgets the speed."""

    name: ClassVar[str] = "blurred"

    @staticmethod
    def state(observation: Any) -> Sequence[float]:
        return tuple(observation[:1])


PIECE = 7
"""Steps after which :class:`Restarting` restarts."""


class Whole(PointEnv):
    """Takes whole numbers, of a type that is given."""

    def __init__(self, dtype: Any = np.int64) -> None:
        super().__init__(wall=1e9)
        self.action_space = Box(-2, 2, (1,), dtype)
        self.taken: list[Any] = []
        TAKEN.append(self.taken)

    def step(self, action: Any) -> Any:
        assert action.dtype == self.action_space.dtype
        self.taken.append(action.copy())
        return super().step(action)


TAKEN: list[list[Any]] = []
"""Actions of each environment of the class :class:`Whole`."""


class Truncating(PointEnv):
    """Truncates after some steps, and goes on as if nothing had happened."""

    def __init__(self, after: int = PIECE, spread: float = 50.0) -> None:
        super().__init__(wall=1e9)
        self.after, self.spread, self.count = after, spread, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.count = 0
        info = super().reset(seed=seed, options=options)[1]
        self.place = self.place * 1e3  # far apart: who learns across it learns nonsense
        self.speed = self.np_random.uniform(-self.spread, self.spread, 1)
        return np.concatenate([self.place, self.speed]), info

    def step(self, action: Any) -> Any:
        observation, *rest = super().step(action)
        self.count += 1
        over = self.count >= self.after
        return self.after_step(observation, over), rest[0], rest[1], over, rest[3]

    def after_step(self, observation: Any, over: bool) -> Any:  # noqa: ARG002
        return observation


class Restarting(Truncating):
    """Restarts by itself, and shows the new start in place of the last state."""

    def after_step(self, observation: Any, over: bool) -> Any:
        return self.reset()[0] if over else observation


class OldReset(PointEnv):
    def reset(self) -> Any:  # type: ignore[override]
        return super().reset()[0]


class FourValues(PointEnv):
    def step(self, action: Any) -> Any:
        observation, reward, terminated, _, info = super().step(action)
        return observation, reward, terminated, info


class NotFinite(PointEnv):
    def step(self, action: Any) -> Any:
        observation, *rest = super().step(action)
        return np.where(np.abs(self.place).max() > 0.2, np.nan, observation), *rest


class Failing(PointEnv):
    def step(self, action: Any) -> Any:
        if np.abs(self.place).max() > 0.2:
            raise RuntimeError("the simulator has gone")
        return super().step(action)


class Tau(PointEnv):
    dt = None  # type: ignore[assignment]
    tau = 0.02


class OneSided(PointEnv):
    def __init__(self) -> None:
        super().__init__(wall=1e9)
        self.action_space = Box(0.0, 2.0, (1,))


class Seedless(PointEnv):
    """Ignores the seed of its reset."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:  # noqa: ARG002
        observation, info = super().reset()
        return observation, info


class Shaken(PointEnv):
    """Has noise of a generator that its seed does not reach."""

    def step(self, action: Any) -> Any:
        self.speed = self.speed + 0.01 * np.random.standard_normal()  # noqa: NPY002  # an unseeded draw is the fault
        return super().step(action)


class Writing(PointEnv):
    """Writes into the action that it is given."""

    def step(self, action: Any) -> Any:
        returned = super().step(action)
        action[:] = 0.0
        return returned


class OneBuffer(PointEnv):
    """Returns the same array each time."""

    def __init__(self) -> None:
        super().__init__(wall=1e9)
        self.buffer = np.zeros(2)

    def reset(self, **given: Any) -> Any:
        self.buffer[:], info = super().reset(**given)
        return self.buffer, info

    def step(self, action: Any) -> Any:
        observation, *rest = super().step(action)
        self.buffer[:] = observation
        return self.buffer, *rest


for kind in (OldReset, FourValues, NotFinite, Failing, Tau, Seedless, Shaken, Writing):
    register(kind, wall=1e9)
for kind in (Whole, Truncating, Restarting, OneSided, OneBuffer):
    register(kind)
register(Restarting, "Single", after=1)
register(Restarting, "Near", spread=2.0)
register(Whole, "Double", dtype=np.float64)

SEEN: list[Any] = []
"""Accelerations that :class:`Noting` was taught last, (T, r)."""


@dataclass(frozen=True, kw_only=True)
class Noting(CustomLearner):
    """Learns nothing, and notes what it is taught."""

    name: ClassVar[str] = "noting"

    def updater(self, system: System, rng: np.random.Generator) -> Updater:  # noqa: ARG002
        return NotingUpdater()


class NotingUpdater(Updater):
    def update(self, view: TrialView) -> Any:
        SEEN[:] = [view.sampled.copy(), view.sampled_inputs.copy(), view.accelerations.copy()]
        return view.parameters
