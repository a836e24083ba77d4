"""Users' policies and learners, written in numpy: copies of shipped ones, and bad ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.learning.base import CustomLearner, Updater
from dopt.policies.base import Array, CustomPolicy, Planner
from dopt.systems import System
from dopt.trial_view import TrialView


@dataclass(frozen=True, kw_only=True)
class Copy(CustomPolicy):
    """Algorithm 2 for one input and one learned acceleration, in the words of Proposition 1."""

    name: ClassVar[str] = "copy"

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        return CopyPlanner(system)


class CopyPlanner(Planner):
    def __init__(self, system: System) -> None:
        self._system = system
        self._information: Array | None = None

    def choose(self, view: TrialView) -> Array:
        assert self._information is not None
        center = view.following(view.states[-1], np.zeros((1, 1)))[0]
        g = view.jacobian(center)[0]
        changes = view.jacobian_change(center, view.input_matrix(center).T)[:, 0]
        v = -changes @ np.linalg.solve(self._information, g)
        chosen: Array = -self._system.gamma * np.sign(v)
        return chosen

    def observe(self, view: TrialView) -> None:
        J = view.jacobian(view.states[-2])
        before = 1e-3 * np.eye(J.shape[1]) if self._information is None else self._information
        self._information = before + J.T @ J


@dataclass(frozen=True, kw_only=True)
class Wild(CustomPolicy):
    """Chooses what it may not: ``scale`` times γ, in ``size`` inputs; or gets lost."""

    name: ClassVar[str] = "wild"

    scale: float = 2.0
    size: int = 1

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        return WildPlanner(system.gamma * self.scale, self.size)


class WildPlanner(Planner):
    def __init__(self, value: float, size: int) -> None:
        self._inputs = np.full(size, value)

    def choose(self, view: TrialView) -> Array:
        return np.where(view.t < 5, 0.0, self._inputs) if len(self._inputs) == 1 else self._inputs


@dataclass(frozen=True, kw_only=True)
class Lost(Wild):
    name: ClassVar[str] = "lost"

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        return WildPlanner(np.nan, 1)


@dataclass(frozen=True, kw_only=True)
class Coin(CustomPolicy):
    """±γ/√m along each axis, by chance."""

    name: ClassVar[str] = "coin"

    def planner(self, system: System, rng: np.random.Generator) -> Planner:
        return CoinPlanner(system.gamma, rng)


class CoinPlanner(Planner):
    def __init__(self, gamma: float, rng: np.random.Generator) -> None:
        self._gamma, self._rng = gamma, rng

    def choose(self, view: TrialView) -> Array:
        m = view.inputs.shape[1]
        return self._rng.choice([-self._gamma, self._gamma], size=m) / np.sqrt(m)


@dataclass(frozen=True, kw_only=True)
class Tampering(CustomPolicy):
    """Writes into what was observed."""

    name: ClassVar[str] = "tampering"

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        return TamperingPlanner()


class TamperingPlanner(Planner):
    def choose(self, view: TrialView) -> Array:
        view.states[0] = 0.0
        return view.inputs[-1]


@dataclass(frozen=True, kw_only=True)
class Misasking(CustomPolicy):
    """Asks for the states that follow with one axis too many."""

    name: ClassVar[str] = "misasking"

    of_inputs: int = 0

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        return MisaskingPlanner(self.of_inputs)


class MisaskingPlanner(Planner):
    def __init__(self, of_inputs: int) -> None:
        self._of_inputs = of_inputs

    def choose(self, view: TrialView) -> Array:
        x, m = view.states[-1:], view.system.n_inputs
        if self._of_inputs:
            return view.following(x[0], np.zeros((1, m + 1)))
        return view.jacobian(x)


@dataclass(frozen=True, kw_only=True)
class InTorch(Coin):
    """Says that it is written in torch."""

    name: ClassVar[str] = "in_torch"
    compiled: ClassVar[bool] = False


ANSWERS: list[dict[str, Array]] = []
"""Answers of views to the plans of :class:`Asking`, step by step."""


@dataclass(frozen=True, kw_only=True)
class Asking(CustomPolicy):
    """Random directions, for which the model is not asked; all that it is asked is kept."""

    name: ClassVar[str] = "asking"

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        return AskingPlanner()


class AskingPlanner(Planner):
    def choose(self, view: TrialView) -> Array:
        x, u = view.states[-1], view.system.gamma * view.tie
        matrix = view.input_matrix(x)
        answers = {
            "predict": view.predict(view.states[::-1]),  # not contiguous
            "jacobian": view.jacobian(x),
            "jacobian_change": view.jacobian_change(x, matrix.T),
            "following": view.following(x, np.array([u, -0.5 * u])),
            "input_matrix": matrix,
        }
        given = ("states", "inputs", "sampled_inputs", "sampled", "accelerations", "parameters")
        answers |= {name: np.array(getattr(view, name)) for name in given}
        ANSWERS.append(answers)
        return u


@dataclass(frozen=True, kw_only=True)
class Descent(CustomLearner):
    """Adam on the newest sample, as printed in Algorithm 1; ``extra`` parameters are a mistake."""

    name: ClassVar[str] = "descent"

    extra: int = 0

    def updater(self, system: System, rng: np.random.Generator) -> Updater:  # noqa: ARG002
        return DescentUpdater(self.extra)


@dataclass(frozen=True, kw_only=True)
class TaughtInTorch(Descent):
    """Says that it is written in torch."""

    name: ClassVar[str] = "taught_in_torch"
    compiled: ClassVar[bool] = False


class DescentUpdater(Updater):
    def __init__(self, extra: int) -> None:
        self._first, self._second, self._extra = np.zeros(1), np.zeros(1), extra

    def update(self, view: TrialView) -> Array:
        x, y = view.states[-2], view.accelerations[-1]
        gradient = 2 * (view.predict(x[None])[0] - y) @ view.jacobian(x)
        self._first = 0.9 * self._first + 0.1 * gradient
        self._second = 0.999 * self._second + 0.001 * gradient**2
        scale = np.sqrt(self._second / (1 - 0.999**view.t)) + 1e-8
        theta = view.parameters - 2e-3 * self._first / (1 - 0.9**view.t) / scale
        return np.concatenate([theta, np.zeros(self._extra)])
