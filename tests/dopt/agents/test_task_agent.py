"""Trials of the soft actor-critic: what it is given, when it decides, and how it is assessed."""

from __future__ import annotations

import dataclasses
import importlib.util

import numpy as np
import pytest

from dopt.agents.action import input_of
from dopt.agents.task_agent import ActorFeedback, TaskAgent
from dopt.control import Control
from dopt.control.episode import costs, run_feedback
from dopt.control.task import GOALS
from dopt.errors import IncompatibleError, SpecificationError
from dopt.forecasts import true_forecast
from dopt.policies import ActiveExploration, SoftActorCritic
from dopt.policies.base import CustomPolicy
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import Pendulum
from tests.dopt.test_assessment import short
from tests.dopt.trials import trial

pytestmark = pytest.mark.xdist_group("agents")  # one process loads the library


def assessed(**task: object) -> TrialSpec:
    return short("pendulum", "sac", **task)


def test_the_paths_agree_and_a_repetition_is_the_same() -> None:
    spec = trial("cartpole", "sac", 1)
    found = [run_trial(spec), run_trial(spec), run_trial(spec, "reference")]
    np.testing.assert_array_equal(found[0].inputs, found[1].inputs)
    np.testing.assert_allclose(found[2].inputs, found[0].inputs, rtol=1e-4)
    np.testing.assert_allclose(found[2].states, found[0].states, rtol=1e-4, atol=1e-6)


def test_an_input_is_held_between_two_decisions() -> None:
    inputs = run_trial(trial("arm", "sac")).inputs[1:]
    assert np.all(np.linalg.norm(inputs, axis=1) <= 5.0 * (1 + 1e-12))
    for start in range(0, 27, 3):
        assert np.all(inputs[start : start + 3] == inputs[start])
    assert len(np.unique(inputs[:, 0])) == 10


@pytest.mark.parametrize("policy", ["sac", "max_agent"])
@pytest.mark.parametrize("env", ["arm", "pendulum"])
def test_with_the_full_energy_every_input_has_the_largest_norm(env: str, policy: str) -> None:
    inputs = run_trial(trial(env, policy, policy={"energy": "full"})).inputs
    gamma = trial(env, policy).system.gamma
    np.testing.assert_allclose(np.linalg.norm(inputs, axis=1), gamma, rtol=1e-12)
    assert len(np.unique(inputs[:, 0])) > 1


def test_an_action_of_zero_has_an_input_of_the_full_energy() -> None:
    np.testing.assert_array_equal(input_of(np.zeros((2, 3)), 5.0, "full"), [[5.0, 0.0, 0.0]] * 2)


def test_the_transitions_are_those_of_the_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[tuple[np.ndarray, ...]] = []
    monkeypatch.setattr(
        "dopt.agents.soft_actor_critic.Agent.remember",
        lambda _, *parts: kept.append(parts),
    )
    monkeypatch.setattr("dopt.agents.soft_actor_critic.Agent.learn", lambda *_: None)
    spec = trial("pendulum", "sac")
    result, goal = run_trial(spec), GOALS["pendulum"]
    assert len(kept) == 9
    for number, (before, action, reward, following) in enumerate(kept):
        t = 1 + 3 * number
        seen = np.array([np.cos(result.states[t, 0]), np.sin(result.states[t, 0])])
        np.testing.assert_allclose(before[0, :2], seen)
        np.testing.assert_allclose(2.0 * action[0], result.inputs[t])
        reached, applied = result.states[t + 1 : t + 4], result.inputs[t : t + 3]
        cost = costs(spec.system, goal, reached, applied)
        assert reward.shape == (1,)
        assert reward[0] == pytest.approx(-np.mean(cost))
        np.testing.assert_allclose(following[0, 2], result.states[t + 3, 1] / 8.0)


def test_its_own_feedback_is_assessed_beside_the_model() -> None:
    spec = assessed()
    result = run_trial(spec)
    measured = {(row.t, row.measure): row.value for row in result.assessments}
    for t in (0, 10, 30):
        assert measured[t, "feedback_success"] in (0.0, 1.0)
        assert measured[t, "feedback_cost"] > 0
        assert (t, "control_success") in measured
    assert measured[10, "feedback_cost"] != measured[30, "feedback_cost"]
    by_reference = {(r.t, r.measure): r.value for r in run_trial(spec, "reference").assessments}
    assert set(by_reference) == set(measured)
    for t in (0, 10, 30):
        other = by_reference[t, "feedback_cost"]
        assert other == pytest.approx(measured[t, "feedback_cost"], rel=1e-3)


def test_other_policies_have_no_feedback() -> None:
    result = run_trial(short("pendulum", "random"))
    assert not any(row.measure.startswith("feedback") for row in result.assessments)


def test_it_works_for_the_goal_of_the_trial() -> None:
    own, other = assessed(), assessed(goal=[1.0, 0.0])
    changed = {"steps": 12, "settle_steps": 2, "lookahead": 3}
    assert own.config.goal == dataclasses.replace(GOALS["pendulum"], **changed)
    assert other.config.goal.goal == (1.0, 0.0)
    without = trial("pendulum", "sac").config.goal
    assert without == GOALS["pendulum"]


def test_a_system_without_a_task_is_refused() -> None:
    with pytest.raises(IncompatibleError, match=r"'sac'.*a section task with a goal"):
        trial("van_der_pol", "sac")


@pytest.mark.parametrize("policy", [SoftActorCritic(), ActiveExploration()])
def test_a_missing_library_is_said(policy: CustomPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda *_: None)
    message = r"needs the library stable_baselines3.*pip install 'dopt-exploration\[agents\]'"
    with pytest.raises(SpecificationError, match=message):
        policy.planner(Pendulum(), np.random.default_rng(0))


def test_the_agent_learns_to_hold_a_point() -> None:
    """The set point is near rest, so that few samples are enough; the untrained agent misses it."""
    goal = dataclasses.replace(
        GOALS["pendulum"], goal=(0.3, 0.0), tolerances=(0.15, 1.0), steps=150, settle_steps=20
    )
    policy = SoftActorCritic(hold=5, warm_up=100, units=32, batch=64, discount=0.9, updates=2.0)
    task = Control(**dataclasses.asdict(goal), checkpoints=())
    given = trial("pendulum", "sac", 3, env={"horizon": 1200})
    config = dataclasses.replace(given.config, policy=policy, task=task)
    result = run_trial(TrialSpec(config, 3))
    cost = {r.t: r.value for r in result.assessments if r.measure == "feedback_cost"}
    assert cost[1200] < 0.3 * cost[0]


class Constant:
    """A law that gives the number of its calls."""

    hold = 4

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, state: np.ndarray) -> np.ndarray:  # noqa: ARG002
        self.calls += 1
        return np.array([0.01 * self.calls])


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


def test_the_law_of_the_agent_is_within_the_bound() -> None:
    arm = trial("arm", "sac")
    agent = arm.policy.planner(arm.system, np.random.default_rng(0))  # type: ignore[attr-defined]
    assert isinstance(agent, TaskAgent)
    law = agent.feedback()
    assert isinstance(law, ActorFeedback)
    states = np.random.default_rng(1).normal(size=(50, 4)) * 5
    inputs = np.array([law(x) for x in states])
    assert np.all(np.linalg.norm(inputs, axis=1) <= arm.system.gamma * (1 + 1e-12))
