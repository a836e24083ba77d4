"""Times of a custom compiled policy and learner beside the times of shipped ones.

Both run the same algorithm: the user's classes are written over the same documented structures and
functions as the shipped ones.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from benchmarks.rows import Row, show
from benchmarks.trials import cartpole, cost, run_in_turn
from dopt.kernel.model import write_network_gradients
from dopt.kernel.plugin import (
    Trial,
    adam_step,
    input_columns,
    predicted_state,
    quadratic_forms,
    store_sample,
)
from dopt.learning import AdamWindow
from dopt.learning.base import CompiledLearner
from dopt.policies import InformationPolicy
from dopt.policies.base import CompiledPolicy
from dopt.spec.trial import TrialSpec
from dopt.types import Vector


@dataclass(frozen=True, kw_only=True)
class OwnDOptimal(CompiledPolicy, InformationPolicy):
    """Algorithm 2 for one input and a network, as a user would write it."""

    name: ClassVar[str] = "own_d_optimal"

    @staticmethod
    def plan(trial: Trial, t: int, u: Vector) -> None:
        """Write ±γ, by the sign of gᵀM⁻¹ D B."""
        plant, theta = trial.plant, trial.state.theta
        component, tie = trial.randomness.components[t], trial.randomness.ties[t]
        bar = predicted_state(plant, trial.network, theta, trial.record.states[t])
        columns = input_columns(plant, bar)
        G = np.empty((2, theta.shape[0]))
        write_network_gradients(trial.network, theta, bar, columns, component, G)
        S = quadratic_forms(trial.state.covariance, G[:1], G)
        up = S[0, 1] > 0.0 or (S[0, 1] == 0.0 and tie[0] > 0.0)
        u[0] = plant.gamma if up else -plant.gamma

    def chosen_form(self, n_parameters: int, n_rows: int) -> str:  # noqa: ARG002  # one form only
        """Return the form in which M is held."""
        return "primal"


@dataclass(frozen=True, kw_only=True)
class OwnAdam(CompiledLearner, AdamWindow):
    """Adam on a window, as a user would write it."""

    name: ClassVar[str] = "own_adam"
    compiled: ClassVar[bool] = True

    @staticmethod
    def learn(trial: Trial, t: int, target: Vector) -> None:
        """Take Adam's step t + 1 on the samples in the window."""
        features, targets = trial.state.window_features, trial.state.window_targets
        store_sample(trial.network, features, targets, t, trial.record.states[t], target)
        if t + 1 < features.shape[1]:
            features = features[:, : t + 1].copy()
            targets = targets[:, : t + 1].copy()
        adam_step(trial, t, features, targets)


def measure(quick: bool) -> list[Row]:
    """Return planning and learning times of shipped and own classes, and their ratios."""
    rounds = 2 if quick else 15
    shipped = cartpole()
    results, _ = run_in_turn(
        {
            "shipped": shipped,
            "policy": _with(shipped, "policy", OwnDOptimal),
            "learner": _with(shipped, "learner", OwnAdam),
        },
        rounds,
    )
    plan = {
        name: cost(results[name], lambda result: result.plan_us).mean
        for name in ("shipped", "policy")
    }
    learn = {
        name: cost(results[name], lambda result: result.learn_us).mean
        for name in ("shipped", "learner")
    }
    ratio = "a user's own takes {:.2f} times the shipped one's time"
    return [
        Row("plan, shipped D-optimal", plan["shipped"], "µs"),
        Row(
            "plan, a user's own D-optimal",
            plan["policy"],
            "µs",
            note=ratio.format(plan["policy"] / plan["shipped"]),
        ),
        Row("learn, shipped Adam", learn["shipped"], "µs"),
        Row(
            "learn, a user's own Adam",
            learn["learner"],
            "µs",
            note=ratio.format(learn["learner"] / learn["shipped"]),
        ),
    ]


def _with(spec: TrialSpec, section: str, cls: type) -> TrialSpec:
    """Return a trial with a class of one's own in a section."""
    own = {"_target_": f"{cls.__module__}.{cls.__qualname__}"}
    return TrialSpec.from_mapping({**spec.to_mapping(), section: own})


if __name__ == "__main__":
    show(measure("--quick" in sys.argv))
