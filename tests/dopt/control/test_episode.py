from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from dopt.assessment import true_forecast
from dopt.control import Control
from dopt.control.planning import Forecast, costs, run_episode, succeeds
from dopt.control.task import GOALS
from dopt.systems import SYSTEMS, Pendulum, Quadrotor
from dopt.systems.base import System


def by_the_truth(system: System) -> tuple[Forecast, Forecast]:
    """Return the plant and the forecast of a planner that knows it."""
    return true_forecast(system), true_forecast(system)


def quiet(task: Control, system: System) -> np.ndarray:
    return np.zeros((task.on(system).steps, system.n_states))


@pytest.mark.parametrize("name", sorted(GOALS))
def test_the_true_model_succeeds(name: str) -> None:
    system, task = SYSTEMS[name](), Control()
    noise = np.random.default_rng(1).standard_normal((task.on(system).steps, system.n_states))
    noise *= system.noise * math.sqrt(system.dt)
    episode = run_episode(system, task, *by_the_truth(system), noise, np.random.default_rng(2))
    assert episode.success
    assert np.all(np.linalg.norm(episode.inputs, axis=1) <= system.gamma * (1 + 1e-12))


def test_without_a_plan_worth_the_name_the_pendulum_hangs() -> None:
    pendulum, task = Pendulum(), Control(samples=1, elites=1, iterations=1)
    episode = run_episode(
        pendulum, task, *by_the_truth(pendulum), quiet(task, pendulum), np.random.default_rng(0)
    )
    assert not episode.success
    assert np.all(episode.inputs == 0.0)
    assert episode.cost == pytest.approx(4.0 * task.on(pendulum).steps, rel=1e-3)


def test_the_plant_is_the_true_system_with_its_noise() -> None:
    pendulum, task = Pendulum(), Control(steps=20, settle_steps=1)
    noise = np.random.default_rng(3).standard_normal((20, 2))
    episode = run_episode(pendulum, task, *by_the_truth(pendulum), noise, np.random.default_rng(0))
    for t in range(20):
        x, u = episode.states[t], episode.inputs[t]
        expected = x + pendulum.dt * pendulum.derivative(x, u) + noise[t]
        np.testing.assert_allclose(episode.states[t + 1], expected, rtol=1e-12)
    goal = task.on(pendulum)
    assert episode.cost == pytest.approx(
        sum(costs(pendulum, goal, episode.states[1:], episode.inputs))
    )


def test_an_angle_costs_no_more_after_a_turn() -> None:
    pendulum = Pendulum()
    goal = dataclasses.replace(GOALS["pendulum"], state_weights=(2.0, 0.5), input_weight=0.25)
    inputs = np.array([[2.0]])
    for turn in (0.0, 2 * math.pi, -4 * math.pi):
        state = np.array([[math.pi + 1e-3 + turn, 3.0]])
        expected = 2.0 * 1e-6 + 0.5 * 9.0 + 0.25 * 4.0
        assert costs(pendulum, goal, state, inputs)[0] == pytest.approx(expected, rel=1e-9)


def test_success_is_what_the_last_states_say() -> None:
    pendulum = Pendulum()
    goal = dataclasses.replace(GOALS["pendulum"], settle_steps=3, tolerances=(0.1, 0.0))
    states = np.array([[0.0, 0.0], [-math.pi, 9.0], [math.pi + 0.05, 0.0], [3 * math.pi, 0.0]])
    assert succeeds(pendulum, goal, states)
    assert not succeeds(pendulum, dataclasses.replace(goal, settle_steps=4), states)
    assert not succeeds(pendulum, dataclasses.replace(goal, tolerances=(0.1, 8.0)), states)


def test_a_plant_beyond_its_limit_fails_at_infinite_cost() -> None:
    quadrotor, task = Quadrotor(state_limit=1.0), Control(steps=60, settle_steps=1)
    episode = run_episode(
        quadrotor, task, *by_the_truth(quadrotor), quiet(task, quadrotor), np.random.default_rng(0)
    )
    assert (episode.cost, episode.success) == (math.inf, False)
