"""Agents: what they are given, when they decide, what they learn, how they are assessed."""

from __future__ import annotations

import dataclasses
import math
import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dopt.control import Control
from dopt.control.planning import costs
from dopt.control.task import GOALS
from dopt.errors import IncompatibleError, SpecificationError
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import Cartpole, Quadrotor
from orchestrate import __main__ as orchestrate
from orchestrate import launch
from studies.agents.policies import (
    LIMIT,
    ActiveExploration,
    ActorFeedback,
    Agent,
    ImaginingAgent,
    NormalEnsemble,
    Observation,
    Settings,
    SoftActorCritic,
    TaskAgent,
    input_of,
    jensen_renyi_divergence,
)
from tests.dopt.test_assessment import SHORT
from tests.dopt.trials import trial
from tests.paths import ROOT

SMALL: dict[str, dict[str, Any]] = {
    "SoftActorCritic": {"hold": 3, "warm_up": 9, "units": 8, "batch": 4},
    "ActiveExploration": {
        **{"ensemble": 3, "units": 8, "warm_up": 10, "replan_every": 10, "fit_updates": 20},
        **{"hold": 4, "lookahead": 6, "actors": 6, "episodes": 2, "batch": 8},
    },
}
AGENTS = tuple(SMALL)


def agent_trial(env: str, agent: str, seed: int = 0, /, **fields: Mapping[str, Any]) -> TrialSpec:
    """Return a small trial of an agent; ``fields`` are the entries of sections that differ."""
    target = {"_target_": f"studies.agents.policies.{agent}", **SMALL[agent]}
    policy, task = target | dict(fields.pop("policy", {})), fields.pop("task", None)
    sections = trial(env, "random", seed, **fields).to_mapping() | {"policy": policy}
    return TrialSpec.from_mapping(sections | ({"task": task} if task else {}))


@pytest.mark.parametrize("agent", AGENTS)
def test_a_repetition_is_the_same(agent: str) -> None:
    spec = agent_trial("cartpole", agent, 1)
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


def test_the_transitions_follow_the_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[tuple[np.ndarray, ...]] = []
    monkeypatch.setattr(
        "studies.agents.policies.Agent.remember", lambda _, *parts: kept.append(parts)
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


def test_it_works_for_the_goal_of_the_trial() -> None:
    own, other = (
        agent_trial("pendulum", "SoftActorCritic", 1, task=SHORT | goal)
        for goal in ({}, {"goal": [1.0, 0.0]})
    )
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


QUICK = SMALL["ActiveExploration"]


def test_decisions_are_held_and_each_plan_begins_with_one() -> None:
    inputs = run_trial(agent_trial("arm", "ActiveExploration")).inputs
    assert np.all(np.linalg.norm(inputs, axis=1) <= 5.0 * (1 + 1e-12))
    changes = 1 + np.flatnonzero(np.any(np.diff(inputs, axis=0) != 0, axis=1))
    assert changes.tolist() == [1, 5, 9, 10, 14, 18, 20, 24, 28]


def test_any_model_and_learner_go_with_it() -> None:
    for learner in ("ekf", "gauss_newton"):
        result = run_trial(agent_trial("pendulum", "ActiveExploration", learner={"name": learner}))
        assert np.isfinite(result.loss).all()


def test_imagined_steps_follow_the_system_with_the_networks_accelerations() -> None:
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


def test_an_angle_is_shown_by_cosine_and_sine_and_others_by_half_widths() -> None:
    cartpole = Cartpole(grid_half_widths=(4.0, math.pi, 8.0))
    state = np.array([0.5, 2.0, math.pi / 6 + 4 * math.pi, -4.0])
    expected = [math.sqrt(3) / 2, 0.5, 0.5, 0.5, -0.5]
    np.testing.assert_allclose(Observation(cartpole)(state), expected)


def test_many_states_are_shown_row_by_row() -> None:
    observation = Observation(Quadrotor())
    states = np.random.default_rng(0).normal(size=(3, 5, 6))
    shown = observation(states)
    assert shown.shape == (3, 5, observation.size) == (3, 5, 7)
    np.testing.assert_array_equal(shown[1, 2], observation(states[1, 2]))


def test_nothing_large_is_shown() -> None:
    states = np.array([[1e9, -1e9, 1.0, 0.0]])
    shown = Observation(Cartpole())(states)
    assert np.abs(shown).max() == LIMIT


CONF = ("--config-dir", str(ROOT / "studies/agents/conf"), "-m", "seed=0")


def test_an_agent_is_a_policy_of_a_launch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    url = f"sqlite:///{tmp_path}/results.db"
    words = ("policy=sac", "env.horizon=20", "policy.warm_up=5", "policy.batch=4")
    words += ("executor=inprocess", f"store.url={url}")
    monkeypatch.setattr("sys.argv", ["launch.py", *CONF, *words])
    assert launch.main() == 0
    capsys.readouterr()
    assert orchestrate.main(["status", "--db", url]) == 0
    assert "sac" in capsys.readouterr().out


@pytest.mark.parametrize("word", ["policy=beyond/sac", "experiment=flex_table1_agents"])
def test_the_place_where_an_agent_was_names_the_study(
    word: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["launch.py", "-m", word])
    assert launch.main() == 2
    assert "studies/agents/README.md" in capsys.readouterr().err


def test_every_trial_of_the_experiment_is_possible(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ("experiment=agents", "launch.dry_run=true", f"store.url=sqlite:///{tmp_path}/r.db")
    monkeypatch.setattr("sys.argv", ["launch.py", *CONF, *words])
    assert launch.main() == 0
    assert "8 trials, 0 done" in capsys.readouterr().out


SETTINGS = Settings(
    units=32, learning_rate=3e-3, batch_size=64, gamma=0.0, ent_coef=1e-3, buffer_size=500
)


def agent(seed: int = 0, n_actors: int = 1) -> Agent:
    return Agent(2, 1, SETTINGS, np.random.default_rng(seed), n_actors)


def fed(one: Agent, steps: int, n_actors: int = 1) -> Agent:
    """Give it transitions whose best action is half the first observed number."""
    rng = np.random.default_rng(1)
    for _ in range(steps):
        observed = rng.uniform(-1.0, 1.0, (n_actors, 2))
        actions = rng.uniform(-1.0, 1.0, (n_actors, 1))
        rewards = -((actions - 0.5 * observed[:, :1]) ** 2)[:, 0]
        one.remember(observed, actions, rewards, observed)
    return one


def test_it_learns_the_best_action() -> None:
    learned = fed(agent(n_actors=2), 250, n_actors=2)
    observed = np.linspace(-0.9, 0.9, 19)[:, None] * [1.0, -1.0]
    before = learned.actor()  # which does not change afterwards
    learned.learn(600)
    errors = [
        np.abs(actor(observed) - 0.5 * observed[:, :1]).mean()
        for actor in (before, learned.actor())
    ]
    assert errors[1] < 0.08 < errors[0]


def test_the_actor_equals_the_library_without_noise() -> None:
    one = fed(agent(), 80)
    one.learn(20)
    observed = np.random.default_rng(2).normal(size=(7, 2))
    expected, _ = one._sac.predict(observed.astype(np.float32), deterministic=True)
    np.testing.assert_allclose(one.actor()(observed), expected, atol=1e-5)
    np.testing.assert_allclose(one.actor()(observed[0]), expected[0], atol=1e-5)


def test_global_generators_go_on_as_if_it_were_not_there() -> None:
    def draws() -> tuple[float, ...]:
        numpy_draw = np.random.random()  # noqa: NPY002  # the generator that may not be touched
        return random.random(), numpy_draw, float(torch.rand(1))

    def begin() -> None:
        random.seed(3)
        np.random.seed(3)  # noqa: NPY002
        torch.manual_seed(3)

    begin()
    expected = draws()
    begin()
    one = fed(agent(), 80)
    one.act(np.zeros((1, 2)))
    one.learn(3)
    assert draws() == expected


def test_two_agents_do_not_disturb_each_other() -> None:
    alone, first, second = agent(), agent(), agent(5)
    for one in (alone, first, second):
        fed(one, 80)
    expected = []
    for _ in range(3):
        alone.learn(2)
        expected.append(alone.act(np.zeros((1, 2))))
    found = []
    for _ in range(3):
        first.learn(2)
        second.learn(1)
        found.append(first.act(np.zeros((1, 2))))
        second.act(np.zeros((1, 2)))
    np.testing.assert_array_equal(found, expected)


def test_what_is_forgotten_is_not_learned_from() -> None:
    one = fed(agent(), 80)
    one.forget()
    observed = np.zeros((1, 2))
    one.remember(observed, np.zeros((1, 1)), np.array([7.0]), observed)
    batch = one._buffer.sample(20)
    assert set(batch.rewards.ravel().tolist()) == {7.0}


SIZES = st.tuples(st.integers(2, 6), st.integers(1, 4), st.integers(1, 3))


def drawn(shape: tuple[int, ...], seed: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return spread * rng.normal(size=shape), rng.uniform(0.1, 2.0, size=shape)


@given(SIZES, st.integers(0, 99), st.floats(0.0, 30.0))
def test_the_divergence_is_at_most_the_logarithm_of_their_number(
    shape: tuple[int, int, int], seed: int, spread: float
) -> None:
    mean, variance = drawn(shape, seed, spread)
    same = np.broadcast_to(variance[:1], shape)
    found = jensen_renyi_divergence(mean, same)
    assert found.shape == shape[1:2]
    assert np.all(found >= -1e-12)
    assert np.all(found <= math.log(shape[0]) + 1e-12)


def test_equal_distributions_do_not_diverge_and_those_far_apart_by_that_logarithm() -> None:
    mean, variance = drawn((1, 3, 2), 0, 1.0)
    repeated = (np.repeat(part, 5, axis=0) for part in (mean, variance))
    np.testing.assert_allclose(jensen_renyi_divergence(*repeated), 0.0, atol=1e-12)
    far = np.arange(4.0)[:, None, None] * 1e6
    np.testing.assert_allclose(jensen_renyi_divergence(far, np.ones_like(far)), math.log(4))


def test_the_divergence_equals_an_integral() -> None:
    mean, variance = drawn((3, 1, 1), 2, 1.0)
    y = np.linspace(-20.0, 20.0, 200_001)
    densities = [
        np.exp(-0.5 * (y - m) ** 2 / v) / math.sqrt(2 * math.pi * v)
        for m, v in zip(mean.ravel(), variance.ravel(), strict=True)
    ]
    entropies = [-math.log(np.trapezoid(density**2, y)) for density in densities]
    mixture = -math.log(np.trapezoid(np.mean(densities, axis=0) ** 2, y))
    found = jensen_renyi_divergence(mean, variance)
    assert found[0] == pytest.approx(mixture - np.mean(entropies), abs=1e-9)


@pytest.fixture(scope="module")
def learned() -> NormalEnsemble:
    rng = np.random.default_rng(0)
    x = rng.uniform(-1.0, 1.0, (400, 1))
    y = 50.0 + 10.0 * np.sin(3.0 * x) + 2.0 * rng.standard_normal((400, 1))
    ensemble = NormalEnsemble((5, 1, 32, 1), 3e-3, rng)
    ensemble.fit(x, y, 1500, 64)
    return ensemble


def test_mean_and_variance_are_learned(learned: NormalEnsemble) -> None:
    x = np.linspace(-0.9, 0.9, 50)[:, None]
    mean, variance = learned.predict(x)
    assert mean.shape == variance.shape == (5, 50, 1)
    assert np.sqrt(np.mean((mean.mean(axis=0) - 50.0 - 10.0 * np.sin(3.0 * x)) ** 2)) < 1.0
    assert 1.4 < np.sqrt(np.median(variance)) < 2.6


def test_the_networks_disagree_where_there_are_no_samples(learned: NormalEnsemble) -> None:
    inside, outside = np.linspace(-0.8, 0.8, 20)[:, None], np.linspace(3.0, 5.0, 20)[:, None]
    near, far = (jensen_renyi_divergence(*learned.predict(x)).mean() for x in (inside, outside))
    assert far > 5 * near


def test_targets_that_do_not_vary_are_no_error() -> None:
    ensemble = NormalEnsemble((2, 1, 8, 1), 1e-3, np.random.default_rng(0))
    ensemble.fit(np.zeros((5, 1)), np.full((5, 1), 3.0), 5, 4)
    mean, variance = ensemble.predict(np.zeros((2, 1)))
    assert np.isfinite(mean).all()
    assert np.all(variance > 0)
