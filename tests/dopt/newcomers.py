"""A policy and a learner as this package would gain them: class, kernel function, no other code."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, TypeVar

import numpy as np

from dopt.kernel.compiler import StoredCode, compiled, content_digest
from dopt.kernel.structs import Trial
from dopt.learning.base import Array, CustomLearner, Updater
from dopt.policies.base import CustomPolicy, Planner
from dopt.systems import System
from dopt.trial_view import TrialView

F = TypeVar("F", bound=Callable[..., object])


def kept(function: F) -> F:
    """Compile a function as the package does, and store its machine code as for a user's.

    The cache keeps functions of the package and of users' classes; here it would be
    compiled in every process, for seconds.
    """
    dispatcher = compiled(function)
    folder = f"own/{content_digest(function)}"
    dispatcher._cache = StoredCode(function, folder)  # type: ignore[attr-defined]
    return dispatcher


@dataclass(frozen=True, kw_only=True)
class Alternating(CustomPolicy):
    """A share of γ along the first axis, with a sign that changes at every step."""

    name: ClassVar[str] = "alternating"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "tests.dopt.newcomers.plan"

    share: float = 0.5

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        return _Planner(self.share * system.gamma * np.eye(system.n_inputs)[0])


class _Planner(Planner):
    def __init__(self, u: Array) -> None:
        self._u = u

    def choose(self, view: TrialView) -> Array:
        return self._u if view.t % 2 == 0 else -self._u


@kept
def plan(trial: Trial, t: int, u: Array) -> None:
    size = trial.algorithm.policy[0] * trial.plant.gamma
    u[:] = 0.0
    u[0] = size if t % 2 == 0 else -size


@dataclass(frozen=True, kw_only=True)
class Average(CustomLearner):
    """Every parameter follows the first observed acceleration."""

    name: ClassVar[str] = "average"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "tests.dopt.newcomers.learn"

    share: float = 0.1

    def updater(self, system: System, rng: np.random.Generator) -> Updater:  # noqa: ARG002
        return _Updater(self.share)


class _Updater(Updater):
    def __init__(self, share: float) -> None:
        self._share = share

    def update(self, view: TrialView) -> Array:
        return view.parameters + self._share * (view.accelerations[-1, 0] - view.parameters)


@kept
def learn(trial: Trial, t: int, target: Array) -> None:  # noqa: ARG001  # the signature of all
    theta = trial.state.theta
    for i in range(len(theta)):
        theta[i] += trial.algorithm.learner[0] * (target[0] - theta[i])
