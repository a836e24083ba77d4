"""Trials of MAX with its own planning."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.errors import IncompatibleError, SpecificationError
from dopt.run import run_trial
from studies.agents.policies import ActiveExploration, ImaginingAgent
from tests.studies.agents.agent_trials import SMALL, agent_trial

QUICK = SMALL["ActiveExploration"]


def test_a_repetition_is_the_same() -> None:
    spec = agent_trial("pendulum", "ActiveExploration", 1)
    np.testing.assert_array_equal(run_trial(spec).inputs, run_trial(spec).inputs)


def test_decisions_are_held_and_each_plan_begins_with_one() -> None:
    inputs = run_trial(agent_trial("arm", "ActiveExploration")).inputs
    assert np.all(np.linalg.norm(inputs, axis=1) <= 5.0 * (1 + 1e-12))
    changes = 1 + np.flatnonzero(np.any(np.diff(inputs, axis=0) != 0, axis=1))
    assert changes.tolist() == [1, 5, 9, 10, 14, 18, 20, 24, 28]


def test_any_model_and_learner_go_with_it() -> None:
    for learner in ("ekf", "gauss_newton"):
        result = run_trial(agent_trial("pendulum", "ActiveExploration", learner={"name": learner}))
        assert np.isfinite(result.loss).all()


def test_imagined_steps_are_those_of_the_system_with_the_networks_accelerations() -> None:
    spec = agent_trial("cartpole", "ActiveExploration")
    system = spec.system
    agent = ImaginingAgent(ActiveExploration(**QUICK), system, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    states, inputs = rng.normal(size=(6, 4)), rng.normal(size=(6, 1))
    truth = system.learned(states)
    same = np.broadcast_to(truth, (3, 6, 2))
    following = agent._following(states, inputs, same, np.zeros_like(same))
    for x, u, reached in zip(states, inputs, following, strict=True):
        np.testing.assert_allclose(reached, x + system.dt * system.derivative(x, u), rtol=1e-12)


def test_each_imagined_step_is_by_one_network() -> None:
    system = agent_trial("pendulum", "ActiveExploration").system
    agent = ImaginingAgent(ActiveExploration(**QUICK), system, np.random.default_rng(0))
    mean = np.repeat(np.array([-1.0, 0.0, 1.0])[:, None, None], 300, axis=1)
    states = np.zeros((300, 2))
    rates = agent._following(states, np.zeros((300, 1)), mean, np.zeros_like(mean))[:, 1]
    found, counts = np.unique(rates / system.dt, return_counts=True)
    np.testing.assert_allclose(found, [-1.0, 0.0, 1.0])
    assert counts.min() > 60


def test_it_goes_where_the_networks_disagree() -> None:
    """One step of the plan matters: two networks differ where the rate is positive alone."""
    system = agent_trial("pendulum", "ActiveExploration").system
    policy = ActiveExploration(**QUICK | {"episodes": 30, "learning_rate": 3e-3, "batch": 32})
    agent = ImaginingAgent(policy, system, np.random.default_rng(0))

    def predicted(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        apart = 5.0 * np.maximum(states[:, 1:], 0.0)
        mean = np.stack([-apart, 0.0 * apart, apart])
        return mean, np.full_like(mean, 1e-2)

    agent._predicted = predicted  # type: ignore[method-assign]
    for _ in range(policy.episodes):
        agent._imagine(np.array([0.0, 0.0]))
    action = agent._agent.actor()(agent._observation(np.array([0.0, 0.0])))
    assert action[0] > 0.5


def test_one_network_is_refused() -> None:
    with pytest.raises(SpecificationError, match="at least 2 networks"):
        ActiveExploration(ensemble=1)


def test_a_run_longer_than_the_trial_is_refused() -> None:
    with pytest.raises(IncompatibleError, match=r"policy\.lookahead is 50 steps"):
        agent_trial("pendulum", "ActiveExploration", policy={"lookahead": 50})
