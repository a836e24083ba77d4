"""Users' policies and learners in numpy: copies of shipped ones, bad ones, and compiled twins."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, TypeVar

import numpy as np

from dopt.kernel.compiler import StoredCode, compiled, content_digest
from dopt.kernel.structs import Trial
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


class Answer(Planner):
    """A plan that is a function of what a trial shows."""

    def __init__(self, choose: Callable[[TrialView], Array]) -> None:
        self._choose = choose

    def choose(self, view: TrialView) -> Array:
        return self._choose(view)


@dataclass(frozen=True, kw_only=True)
class Coin(CustomPolicy):
    """±γ/√m along each axis, by chance."""

    name: ClassVar[str] = "coin"

    def planner(self, system: System, rng: np.random.Generator) -> Planner:
        sides, m = [-system.gamma, system.gamma], system.n_inputs
        return Answer(lambda _: rng.choice(sides, size=m) / np.sqrt(m))


class Watching(Planner):
    """A plan without a choice."""

    def observe(self, view: TrialView) -> None:
        """Look on."""


@dataclass(frozen=True, kw_only=True)
class Unfinished(CustomPolicy):
    """Makes a plan that lacks its choice."""

    name: ClassVar[str] = "unfinished"

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        return Watching()  # type: ignore[abstract]  # as a user may forget it


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
        return Answer(asked)


def asked(view: TrialView) -> Array:
    """Ask a view all that it answers, keep that, and return a random direction."""
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
    ANSWERS.append(answers | {name: np.array(getattr(view, name)) for name in given})
    return u


@dataclass(frozen=True, kw_only=True)
class Descent(CustomLearner):
    """Adam on the newest sample, as printed in Algorithm 1."""

    name: ClassVar[str] = "descent"

    def updater(self, system: System, rng: np.random.Generator) -> Updater:  # noqa: ARG002
        return DescentUpdater()


class DescentUpdater(Updater):
    def __init__(self) -> None:
        self._first, self._second = np.zeros(1), np.zeros(1)

    def update(self, view: TrialView) -> Array:
        x, y = view.states[-2], view.accelerations[-1]
        gradient = 2 * (view.predict(x[None])[0] - y) @ view.jacobian(x)
        self._first = 0.9 * self._first + 0.1 * gradient
        self._second = 0.999 * self._second + 0.001 * gradient**2
        scale = np.sqrt(self._second / (1 - 0.999**view.t)) + 1e-8
        theta: Array = view.parameters - 2e-3 * self._first / (1 - 0.9**view.t) / scale
        return theta


# A policy and a learner as this package would gain them: class, kernel function, no other code

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
    kernel_function: ClassVar[str] = "tests.dopt.custom_plugins.plan_alternating"

    share: float = 0.5

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        u = self.share * system.gamma * np.eye(system.n_inputs)[0]
        return Answer(lambda view: u if view.t % 2 == 0 else -u)


@kept
def plan_alternating(trial: Trial, t: int, u: Array) -> None:
    size = trial.algorithm.policy[0] * trial.plant.gamma
    u[:] = 0.0
    u[0] = size if t % 2 == 0 else -size


@dataclass(frozen=True, kw_only=True)
class Average(CustomLearner):
    """Every parameter follows the first observed acceleration."""

    name: ClassVar[str] = "average"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "tests.dopt.custom_plugins.learn_average"

    share: float = 0.1

    def updater(self, system: System, rng: np.random.Generator) -> Updater:  # noqa: ARG002
        return AverageUpdater(self.share)


class AverageUpdater(Updater):
    def __init__(self, share: float) -> None:
        self._share = share

    def update(self, view: TrialView) -> Array:
        return view.parameters + self._share * (view.accelerations[-1, 0] - view.parameters)


@kept
def learn_average(trial: Trial, t: int, target: Array) -> None:  # noqa: ARG001  # the signature of all
    theta = trial.state.theta
    for i in range(len(theta)):
        theta[i] += trial.algorithm.learner[0] * (target[0] - theta[i])
