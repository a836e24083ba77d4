"""Cost of a step in the kernel beside a plan or an update of a user's own in numpy."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from benchmarks.rows import Row
from dopt.learning.base import CustomLearner, Updater
from dopt.policies.base import CustomPolicy, Planner
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import System
from dopt.trial_view import TrialView
from dopt.types import Array

ROUNDS = 7
NOTE = "in whole trials, with evaluation and the own code"


@dataclass(frozen=True, kw_only=True)
class Directions(CustomPolicy):
    """A random direction in each step: it takes no time of its own."""

    name: ClassVar[str] = "directions"

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002  # view.tie
        return DirectionPlanner()


class DirectionPlanner(Planner):
    def choose(self, view: TrialView) -> Array:
        return view.system.gamma * view.tie


@dataclass(frozen=True, kw_only=True)
class Gradient(CustomLearner):
    """One step along the gradient at the newest sample: one prediction and one Jacobian."""

    name: ClassVar[str] = "gradient_step"

    def updater(self, system: System, rng: np.random.Generator) -> Updater:  # noqa: ARG002  # not random
        return GradientUpdater()


class GradientUpdater(Updater):
    def update(self, view: TrialView) -> Array:
        x, y = view.sampled[-1], view.accelerations[-1]
        step: Array = 1e-3 * (view.predict(x[None])[0] - y) @ view.jacobian(x)
        return view.parameters - step


def measure(quick: bool) -> list[Row]:
    """Return the cost of a whole step on the cartpole, at q = 386, with own parts in numpy."""
    own = {
        "plan in numpy, step with adam_window": {"policy": "Directions"},
        "update in numpy, D-optimal step": {"learner": "Gradient"},
        "plan and update in numpy, step": {"policy": "Directions", "learner": "Gradient"},
    }
    return [
        Row(question, _microseconds(parts, 2 if quick else ROUNDS), "µs", note=NOTE)
        for question, parts in own.items()
    ]


def _microseconds(own: dict[str, str], rounds: int) -> float:
    """Return the time of a step in the quickest whole trial."""
    parts: dict[str, dict[str, object]] = {
        "policy": {"name": "d_optimal"},
        "learner": {"name": "adam_window"},
    }
    parts |= {section: {"_target_": f"{__name__}.{name}"} for section, name in own.items()}
    spec = TrialSpec.from_mapping(
        {"env": {"name": "cartpole"}, "model": {"name": "mlp"}, "seed": 0, **parts}
    )
    run_trial(spec)
    times = []
    for seed in range(rounds):
        start = time.perf_counter()
        result = run_trial(spec.with_seed(seed))
        times.append(1e6 * (time.perf_counter() - start) / result.n_steps)
    return min(times)
