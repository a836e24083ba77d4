"""Control tasks: goals, episodes, free runs, the planner, and policies that learn a task."""

from __future__ import annotations

import dataclasses
import json
import math
from functools import partial
from typing import ClassVar

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from dopt.assessment import true_forecast
from dopt.control import Control
from dopt.control.planning import (
    STARTS,
    Episode,
    Forecast,
    costs,
    cross_entropy,
    forecast_by,
    free_run_error,
    held_out,
    run_episode,
    run_feedback,
    succeeds,
)
from dopt.control.task import GOALS, Goal
from dopt.errors import IncompatibleError, SpecificationError
from dopt.evaluation import reachable_states
from dopt.policies.base import Array, Planner, TaskPolicy
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, Pendulum, Quadrotor, System
from dopt.trial_view import TrialView
from tests.dopt.test_assessment import SHORT
from tests.dopt.trials import trial

TASK = {"name": "control", "checkpoints": [10, 20]}


def with_task(spec: TrialSpec, task: dict[str, object]) -> TrialSpec:
    return TrialSpec.from_mapping({**spec.to_mapping(), "task": task})


def test_the_key_of_a_trial_without_a_task_is_what_it_was() -> None:
    paper = TrialSpec.from_names("pendulum", "d_optimal", seed=3)
    assert "task" not in json.loads(paper.canonical_json())
    assert paper.trial_key == KEY
    for nothing in ({}, {"task": None}, {"task": {"name": "none"}}):
        assert TrialSpec.from_mapping({**paper.to_mapping(), **nothing}).trial_key == KEY


KEY = "0f22ab3dfbe2f10a5e307da6f72e4d93e33e26732ea7b4fb073020366b67c47e"
"""Of this trial without a task in its text, at version 2 of the numbers."""


def test_a_task_is_part_of_the_key_with_every_value() -> None:
    spec = trial("pendulum", "random", 1)
    asked = with_task(spec, TASK)
    assert asked.trial_key != spec.trial_key
    content = json.loads(asked.config_json)["task"]
    assert content["goal"] == list(Control().on(asked.system).goal)
    assert None not in content.values()
    assert TrialSpec.from_mapping(asked.to_mapping()).trial_key == asked.trial_key
    same = with_task(spec, {**TASK, "steps": Control().on(asked.system).steps})
    assert same.trial_key == asked.trial_key
    assert with_task(spec, {**TASK, "steps": 100}).trial_key != asked.trial_key


@dataclasses.dataclass(frozen=True, kw_only=True)
class Swing(Pendulum):
    name = "swing"


def test_a_system_of_ones_own_is_told_what_to_give() -> None:
    with pytest.raises(IncompatibleError, match=r"'swing' has no control task.*task\.goal"):
        Control().on(Swing())
    own = Control(**vars(Control().on(Pendulum())))
    assert own.on(Swing()) == Control().on(Pendulum())


def test_a_system_that_changes_has_no_one_truth_to_be_judged_by() -> None:
    with pytest.raises(IncompatibleError, match=r"'drifting_pendulum' changes .* task=none"):
        with_task(trial("drifting_pendulum", "random"), TASK)


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"goal": [1.0]}, r"task\.goal has 1 entries, but pendulum needs 2"),
        ({"tolerances": [-1.0, 1.0]}, r"task\.tolerances\[0\] is -1\.0"),
        ({"checkpoints": [31]}, r"holds step 31, but a trial has 30 steps"),
        ({"checkpoints": [0]}, r"task\.checkpoints\[0\] is 0"),
        ({"elites": 65}, r"task\.elites is 65, but .* at most task\.samples"),
        ({"settle_steps": 401}, r"task\.settle_steps is 401, .* at most task\.steps"),
        ({"stpes": 3}, r"did you mean 'steps'\?"),
        ({"name": "contrl"}, r"did you mean 'control'\?"),
    ],
)
def test_what_makes_no_sense_is_refused(fields: dict[str, object], sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        with_task(trial("pendulum", "random"), {**TASK, **fields})


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


def check_steps(system: System, episode: Episode, noise: Array) -> None:
    """Check that each step is the system's, with its noise."""
    for x, u, w, after in zip(
        episode.states, episode.inputs, noise, episode.states[1:], strict=False
    ):
        expected = x + system.dt * system.derivative(x, u) + w
        np.testing.assert_allclose(after, expected, rtol=1e-12)


def test_the_plant_is_the_true_system_with_its_noise() -> None:
    pendulum, task = Pendulum(), Control(steps=20, settle_steps=1)
    noise = np.random.default_rng(3).standard_normal((20, 2))
    episode = run_episode(pendulum, task, *by_the_truth(pendulum), noise, np.random.default_rng(0))
    check_steps(pendulum, episode, noise)
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


def test_the_error_of_free_runs_is_known_after_one_step_and_infinite_of_what_explodes() -> None:
    pendulum, truth = Pendulum(), held_out(Pendulum(), 1)
    off = forecast_by(pendulum, lambda states, _: pendulum.learned(states) + 3.0)
    change = np.mean((truth.states[0] - truth.starts)[:, 1] ** 2)
    expected = np.sqrt(0.5 * (pendulum.dt * 3.0) ** 2 / change)
    assert free_run_error(pendulum, off, 1) == pytest.approx(expected, rel=1e-9)
    explosive = forecast_by(pendulum, lambda states, _: 1e300 * states[:, 1:] ** 3)
    assert not np.isfinite(free_run_error(pendulum, explosive, 25))


def test_what_is_held_out_depends_on_the_system_alone() -> None:
    first = held_out(Pendulum(), 25)
    held_out.cache_clear()
    again = held_out(Pendulum(noise=0.1), 25)
    np.testing.assert_array_equal(first.states, again.states)
    assert first.inputs.shape == (256, 25, 1)
    assert np.allclose(np.abs(first.inputs), Pendulum().gamma)


def test_it_starts_all_along_the_reachable_trajectories() -> None:
    """States of the first steps are slow: the system was still gaining energy."""
    system = SYSTEMS["cartpole"]()
    reachable = reachable_states(system)
    starts = held_out(system, 5).starts
    assert len(starts) == STARTS
    late = np.any(np.all(starts[:, None] == reachable[-3:], axis=2), axis=0)
    assert late.any()
    assert starts.std(axis=0) == pytest.approx(reachable.std(axis=0), rel=0.1)


A = np.array([[1.0, 0.1], [0.0, 1.0]])
B = np.array([[0.0], [0.1]])
WEIGHT = 0.1
START = np.array([1.0, 0.0])
HORIZON = 40


def linear_quadratic_cost(plans: np.ndarray) -> np.ndarray:
    """Return Σ ‖x_t‖² + 0.1 u_t² over the horizon, and the Riccati value of the last state."""
    x = np.tile(START, (len(plans), 1))
    total = np.zeros(len(plans))
    for u in plans.swapaxes(0, 1):
        total += np.sum(x**2, axis=1) + WEIGHT * np.sum(u**2, axis=1)
        x = x @ A.T + u @ B.T
    return np.asarray(total + np.sum((x @ riccati()) * x, axis=1))


def riccati() -> np.ndarray:
    return np.asarray(solve_discrete_are(A, B, np.eye(2), WEIGHT * np.eye(1)))


def riccati_plan() -> np.ndarray:
    P = riccati()
    gain = np.linalg.solve(WEIGHT * np.eye(1) + B.T @ P @ B, B.T @ P @ A)
    x, plan = START, []
    for _ in range(HORIZON):
        plan.append(-gain @ x)
        x = A @ x + B @ plan[-1]
    return np.array(plan)


def test_the_plan_of_a_linear_system_is_that_of_riccati() -> None:
    planner = partial(cross_entropy, gamma=5.0, samples=1000, iterations=60, elites=100)
    plan = planner(linear_quadratic_cost, np.zeros((HORIZON, 1)), np.random.default_rng(0))
    best = START @ riccati() @ START
    assert linear_quadratic_cost(riccati_plan()[None])[0] == pytest.approx(best, rel=1e-9)
    assert best <= linear_quadratic_cost(plan[None])[0] <= 1.005 * best
    assert np.sqrt(np.mean((plan - riccati_plan()) ** 2)) < 0.1


def test_a_binding_ball_is_kept_and_used() -> None:
    planner = partial(cross_entropy, gamma=1.0, samples=200, iterations=40, elites=20)
    target = np.array([3.0, 4.0])
    plan = planner(
        lambda plans: np.sum((plans - target) ** 2, axis=(1, 2)),
        np.zeros((5, 2)),
        np.random.default_rng(1),
    )
    np.testing.assert_allclose(plan, np.tile([0.6, 0.8], (5, 1)), atol=0.08)
    assert np.all(np.linalg.norm(plan, axis=1) <= 1.0 + 1e-12)


def test_costs_that_overflow_are_the_worst() -> None:
    planner = partial(cross_entropy, gamma=1.0, samples=64, iterations=10, elites=8)

    def cost(plans: np.ndarray) -> np.ndarray:
        first = plans[:, 0, 0]
        return np.where(first > 0.2, np.nan, np.where(first < -0.2, -np.inf, -first))

    plan = planner(cost, np.zeros((1, 1)), np.random.default_rng(2))
    assert plan[0, 0] == pytest.approx(0.2, abs=0.05)


@pytest.mark.parametrize("seed", range(5))
def test_no_sequence_that_was_tried_is_better_than_the_plan(seed: int) -> None:
    planner = partial(cross_entropy, gamma=1.0, samples=16, iterations=3, elites=8)
    costs: list[float] = []

    def cost(plans: np.ndarray) -> np.ndarray:
        found = np.cos(7 * plans).sum(axis=(1, 2))  # the mean of two optima is not one
        costs.extend(found)
        return np.asarray(found)

    plan = planner(cost, np.zeros((3, 2)), np.random.default_rng(seed))
    assert np.cos(7 * plan).sum() == min(costs)
    optimum, none = (
        np.zeros((3, 2)),
        partial(cross_entropy, gamma=1.0, samples=2, iterations=1, elites=1),
    )
    warm = none(lambda plans: -cost(plans), optimum, np.random.default_rng(seed))
    assert np.array_equal(warm, optimum), "a start that is the best is kept in sight"


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
        return SteadyPlan()


class SteadyPlan(Planner):
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
    with pytest.raises(IncompatibleError, match=r"'steady'.*a section task with a goal"):
        steady("van_der_pol")


def test_an_episode_under_feedback_holds_its_inputs() -> None:
    pendulum = Pendulum()
    goal = dataclasses.replace(GOALS["pendulum"], steps=10, settle_steps=1)
    noise = np.random.default_rng(0).normal(size=(10, 2))
    episode = run_feedback(pendulum, goal, true_forecast(pendulum), Constant(), noise)
    np.testing.assert_allclose(100 * episode.inputs[:, 0], [1] * 4 + [2] * 4 + [3] * 2)
    check_steps(pendulum, episode, noise)
