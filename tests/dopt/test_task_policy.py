"""Policies that learn the task of a trial: their law of feedback is assessed beside the model."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np
import pytest

from dopt.assessment import true_forecast
from dopt.control.planning import run_feedback
from dopt.control.task import GOALS, Goal
from dopt.errors import IncompatibleError
from dopt.policies.base import Array, Planner, TaskPolicy
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import Pendulum, System
from dopt.trial_view import TrialView
from tests.dopt.test_assessment import SHORT, short
from tests.dopt.trials import trial


class Constant:
    """A law that gives the number of its calls."""

    hold = 4

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, state: np.ndarray) -> np.ndarray:  # noqa: ARG002
        self.calls += 1
        return np.array([0.01 * self.calls])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Steady(TaskPolicy):
    """Applies no input, and would solve the task by :class:`Constant`."""

    name: ClassVar[str] = "steady"
    reads_inputs: ClassVar[bool] = True

    def task_planner(self, system: System, goal: Goal, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        return SteadyPlan(goal)


class SteadyPlan(Planner):
    def __init__(self, goal: Goal) -> None:
        self.goal = goal

    def choose(self, view: TrialView) -> Array:
        return np.zeros(view.system.n_inputs)

    def feedback(self) -> Constant:
        return Constant()


def steady(env: str, **task: object) -> TrialSpec:
    sections = trial(env, "random").to_mapping() | {"policy": {"_target_": f"{__name__}.Steady"}}
    return TrialSpec.from_mapping(sections | ({"task": {**SHORT, **task}} if task else {}))


def test_its_own_feedback_is_assessed_beside_the_model() -> None:
    result = run_trial(steady("pendulum", goal=[1.0, 0.0]))
    measured = {(row.t, row.measure): row.value for row in result.assessments}
    for t in (0, 10, 30):
        assert measured[t, "feedback_success"] in (0.0, 1.0)
        assert measured[t, "feedback_cost"] > 0
        assert (t, "control_success") in measured


def test_other_policies_have_no_feedback() -> None:
    result = run_trial(short("pendulum", "random"))
    assert not any(row.measure.startswith("feedback") for row in result.assessments)


def test_a_system_without_a_task_is_refused() -> None:
    with pytest.raises(IncompatibleError, match=r"'steady'.*a section task with a goal"):
        steady("van_der_pol")


def test_an_episode_under_feedback_holds_its_inputs() -> None:
    pendulum = Pendulum()
    goal = dataclasses.replace(GOALS["pendulum"], steps=10, settle_steps=1)
    noise = np.random.default_rng(0).normal(size=(10, 2))
    episode = run_feedback(pendulum, goal, true_forecast(pendulum), Constant(), noise)
    np.testing.assert_allclose(100 * episode.inputs[:, 0], [1] * 4 + [2] * 4 + [3] * 2)
    for t in range(10):
        x, u = episode.states[t], episode.inputs[t]
        expected = x + pendulum.dt * pendulum.derivative(x, u) + noise[t]
        np.testing.assert_allclose(episode.states[t + 1], expected, rtol=1e-12)
