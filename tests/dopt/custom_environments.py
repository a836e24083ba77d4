"""Environments that a Gymnasium of a user might hold, among them a point mass without secrets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

from dopt.fields import parameter
from dopt.gymnasium import Environment
from dopt.systems import Feature

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


for identity, settings in {
    "Point": {"wall": 1e9},
    "Walled": {},
    "Buttons": {"actions": "discrete"},
}.items():
    if f"dopt_tests/{identity}-v0" not in gymnasium.registry:
        gymnasium.register(
            f"dopt_tests/{identity}-v0", PointEnv, kwargs=settings, max_episode_steps=7
        )


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
