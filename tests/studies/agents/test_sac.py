"""Trials of the soft actor-critic: what it is given, when it decides, and how it is assessed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dopt.control import Control
from dopt.control.planning import costs
from dopt.control.task import GOALS
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from studies.agents.policies import ActorFeedback, SoftActorCritic, TaskAgent, input_of
from tests.dopt.test_assessment import SHORT
from tests.studies.agents.agent_trials import AGENTS, agent_trial


def assessed(**task: object) -> TrialSpec:
    return agent_trial("pendulum", "SoftActorCritic", 1, task={**SHORT, **task})


def test_a_repetition_is_the_same() -> None:
    spec = agent_trial("cartpole", "SoftActorCritic", 1)
    np.testing.assert_array_equal(run_trial(spec).inputs, run_trial(spec).inputs)


def test_an_input_is_held_between_two_decisions() -> None:
    inputs = run_trial(agent_trial("arm", "SoftActorCritic")).inputs[1:]
    assert np.all(np.linalg.norm(inputs, axis=1) <= 5.0 * (1 + 1e-12))
    for start in range(0, 27, 3):
        assert np.all(inputs[start : start + 3] == inputs[start])
    assert len(np.unique(inputs[:, 0])) == 10


@pytest.mark.parametrize("policy", AGENTS)
@pytest.mark.parametrize("env", ["arm", "pendulum"])
def test_with_the_full_energy_every_input_has_the_largest_norm(env: str, policy: str) -> None:
    inputs = run_trial(agent_trial(env, policy, policy={"energy": "full"})).inputs
    gamma = agent_trial(env, policy).system.gamma
    np.testing.assert_allclose(np.linalg.norm(inputs, axis=1), gamma, rtol=1e-12)
    assert len(np.unique(inputs[:, 0])) > 1


def test_an_action_of_zero_has_an_input_of_the_full_energy() -> None:
    np.testing.assert_array_equal(input_of(np.zeros((2, 3)), 5.0, "full"), [[5.0, 0.0, 0.0]] * 2)


def test_the_transitions_are_those_of_the_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[tuple[np.ndarray, ...]] = []
    monkeypatch.setattr(
        "studies.agents.policies.Agent.remember",
        lambda _, *parts: kept.append(parts),
    )
    monkeypatch.setattr("studies.agents.policies.Agent.learn", lambda *_: None)
    spec = agent_trial("pendulum", "SoftActorCritic")
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


def test_it_works_for_the_goal_of_the_trial() -> None:
    own, other = assessed(), assessed(goal=[1.0, 0.0])
    changed = {"steps": 12, "settle_steps": 2, "lookahead": 3}
    assert own.config.goal == dataclasses.replace(GOALS["pendulum"], **changed)
    assert other.config.goal.goal == (1.0, 0.0)
    without = agent_trial("pendulum", "SoftActorCritic").config.goal
    assert without == GOALS["pendulum"]


def test_the_agent_learns_to_hold_a_point() -> None:
    """The set point is near rest, so that few samples are enough; the untrained agent misses it."""
    goal = dataclasses.replace(
        GOALS["pendulum"], goal=(0.3, 0.0), tolerances=(0.15, 1.0), steps=150, settle_steps=20
    )
    policy = SoftActorCritic(hold=5, warm_up=100, units=32, batch=64, discount=0.9, updates=2.0)
    task = Control(**dataclasses.asdict(goal), checkpoints=())
    given = agent_trial("pendulum", "SoftActorCritic", 3, env={"horizon": 1200})
    config = dataclasses.replace(given.config, policy=policy, task=task)
    result = run_trial(TrialSpec(config, 3))
    cost = {r.t: r.value for r in result.assessments if r.measure == "feedback_cost"}
    assert cost[1200] < 0.3 * cost[0]


def test_the_law_of_the_agent_is_within_the_bound() -> None:
    arm = agent_trial("arm", "SoftActorCritic")
    agent = arm.policy.planner(arm.system, np.random.default_rng(0))  # type: ignore[attr-defined]
    assert isinstance(agent, TaskAgent)
    law = agent.feedback()
    assert isinstance(law, ActorFeedback)
    states = np.random.default_rng(1).normal(size=(50, 4)) * 5
    inputs = np.array([law(x) for x in states])
    assert np.all(np.linalg.norm(inputs, axis=1) <= arm.system.gamma * (1 + 1e-12))
