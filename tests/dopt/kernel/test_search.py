"""Policies that search, sample, follow a gradient or linearise, against dense algebra."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from dopt.errors import IncompatibleError
from dopt.evaluation import domain_box, evaluation_set, goal_weights, reachable_states, task_states
from dopt.kernel.sampling import domain_weight
from dopt.policies import Lookahead, Search, TaskOptimal
from dopt.policies.d_optimal import is_linear
from dopt.policies.search import PERIOD_SHARE, STEPS_WITHOUT_PERIOD
from dopt.randomness import draw
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from dopt.systems.properties import eigenmode
from dopt.types import Array
from tests.dopt.kernel.twin import interpreted
from tests.dopt.oracles.traces import information, jacobian, model_step, trace
from tests.dopt.trials import trial

SMALL = {"lookahead": 7, "hold": 3, "stride": 2, "plans": 9, "iterations": 2, "elites": 3}


@pytest.mark.parametrize(
    ("policy", "dt"), [("exact", 1e-5), ("trace", 1e-5), ("trace_linearized", 0.02)]
)
def test_of_one_input_and_a_short_step_the_sign_is_d_optimal(policy: str, dt: float) -> None:
    """For dt → 0 the linearisation in u is exact, and one component has one variance."""
    found, expected = (
        run_trial(trial("pendulum", name, 2, env={"horizon": 40, "dt": dt})).inputs
        for name in (policy, "d_optimal")
    )
    assert np.array_equal(found, expected)


def test_plans_that_leave_the_bounds_of_a_state_do_not_count() -> None:
    env = {"horizon": 60, "state_limit": 0.5, "gamma": 1.0}
    plans = {"lookahead": 4}
    careful = run_trial(trial("pendulum", "lookahead", 1, env=env, policy=plans))
    reckless = run_trial(trial("pendulum", "lookahead", 1, env=env | {"state_limit": 1e4}))
    assert np.abs(reckless.states).max() > 0.5
    assert careful.diverged_at is None


def test_where_every_plan_leaves_the_bounds_chance_decides() -> None:
    env = {"horizon": 40, "state_limit": 0.1, "gamma": 1.0}
    spec = trial("pendulum", "lookahead", 1, env=env, policy={"lookahead": 12})
    fast = run_trial(spec)
    end = fast.diverged_at
    assert end is not None
    assert np.array_equal(np.sign(fast.inputs[1:end]), np.sign(draw(spec).ties[1:end]))


def budgeted(budget_us: float) -> TrialSpec:
    given = {"lookahead": 10, "candidates": 8, "budget_us": budget_us}
    return trial("quadrotor", "lookahead", 2, policy=given)


def test_without_time_the_input_nearest_to_a_random_direction_is_taken() -> None:
    """With time enough all plans are scored."""
    spec = budgeted(1e-9)
    assert isinstance(spec.policy, Search)
    candidates = spec.policy.compared_inputs(spec.system)
    nearest = np.argmax(draw(spec).ties @ candidates.T, axis=1)
    assert np.array_equal(run_trial(spec).inputs[1:], candidates[nearest][1:])
    assert np.array_equal(run_trial(budgeted(1e9)).inputs, run_trial(budgeted(0.0)).inputs)


@pytest.mark.parametrize("env", SYSTEMS)
def test_a_plan_lasts_a_share_of_the_natural_period(env: str) -> None:
    system = SYSTEMS[env]()
    mode = eigenmode(system)
    steps = Lookahead().steps(system)
    if mode is None:
        assert steps == STEPS_WITHOUT_PERIOD
    else:
        period = 2 * np.pi / mode.frequency
        assert abs(steps * system.dt - PERIOD_SHARE * period) <= system.dt / 2
    assert Lookahead(lookahead=7).steps(system) == 7
    assert Lookahead(lookahead=27).stride_of(system) == 5
    assert Lookahead(lookahead=27, stride=2).stride_of(system) == 2
    assert Lookahead(lookahead=1).stride_of(system) == 1


def test_the_states_of_a_task_are_those_that_its_goal_weighs() -> None:
    system = SYSTEMS["pendulum"]()
    upright = TaskOptimal(goal=(-3.1, 0.0), radius=0.2, count=20)
    states = task_states(system, upright)
    assert states.shape == (20, 2)
    assert len(np.unique(states, axis=0)) == 20
    distance = np.abs(np.abs(states[:, 0]) - np.pi) / np.pi  # on the circle: both sides of upright
    assert distance.mean() < 0.25
    assert np.abs(states[:, 1] / 8.0).mean() < 0.25
    assert (states[:, 0] > 0).any()
    weights = goal_weights(system, upright, np.array([[-3.1, 0.0], [-3.1, 0.2 * 8.0]]))
    assert weights == pytest.approx([1.0, np.exp(-0.5)])


def test_a_task_without_a_goal_draws_from_the_set_that_it_names() -> None:
    """And is not told where the model is judged."""
    system = SYSTEMS["pendulum"]()
    reachable, judged = (
        {tuple(state) for state in states}
        for states in (reachable_states(system), evaluation_set(system).states)
    )
    box = task_states(system, TaskOptimal(count=10**6))
    assert not (reachable | judged) & {tuple(state) for state in box}
    half_widths = np.array(system.grid_half_widths)
    assert np.all(np.abs(box) <= half_widths)
    assert np.all(np.abs(box).max(axis=0) > 0.99 * half_widths)
    named = task_states(system, TaskOptimal(states="reachable"))
    assert all(tuple(state) in reachable for state in named)


def test_of_a_tiny_task_the_nearest_state_is_left() -> None:
    tiny = TaskOptimal(goal=(1.0, 0.0), radius=1e-300)
    system = SYSTEMS["pendulum"]()
    nearest = task_states(system, TaskOptimal(goal=(1.0, 0.0), radius=1e-3, count=1))
    np.testing.assert_allclose(task_states(system, tiny), nearest, atol=0.2)
    assert len(task_states(system, tiny)) == 1


@pytest.mark.parametrize(
    ("policy", "fields", "message"),
    [
        ("task", {"goal": (1.0,)}, r"policy\.goal has 1 entries, .* has 2: give one for each"),
        ("lookahead", {"lookahead": 4, "stride": 5}, r"policy\.stride is 5 steps, .* have 4: make"),
        ("lookahead", {"lookahead": 31}, r"policy\.lookahead is 31 .* trial .* 30: lower"),
        ("max", {"lookahead": 31}, r"policy\.lookahead is 31 .* trial .* has 30: lower"),
        ("icem", SMALL | {"stride": 8}, "policy.stride is 8 steps, but the plans have 7"),
        ("icem", SMALL | {"elites": 10}, "policy.elites is 10, but an iteration draws 9 plans"),
        ("episodic", SMALL | {"replan_every": 8}, "replan_every is 8 steps, but the plans have 7"),
    ],
)
def test_fields_that_the_system_or_others_do_not_allow_are_refused(
    policy: str, fields: dict[str, Any], message: str
) -> None:
    with pytest.raises(IncompatibleError, match=message):
        trial("pendulum", policy, policy=fields)


@pytest.mark.parametrize("policy", ["exact", "trace", "a_optimal", "e_optimal", "task"])
def test_random_features_are_searched_by_their_weights_alone(policy: str) -> None:
    sections = {"model": {"name": "rff"}, "learner": {"name": "recursive_least_squares"}}
    result = run_trial(trial("pendulum", policy, **sections))
    assert np.isfinite(result.loss).all()
    assert np.abs(result.inputs) == pytest.approx(2.0)


def test_outside_of_the_domain_rows_count_less() -> None:
    """Beside a box that is never left nothing changes, and one that is does make a difference."""
    inputs = {}
    for name, half_widths in (("wide", (7.0, 1e6)), ("narrow", (0.02, 0.02))):
        for domain in ("everywhere", "box"):
            fields = SMALL | {"domain": domain, "lookahead": 12, "stride": 6}
            env = {"grid_half_widths": half_widths, "horizon": 14}
            spec = trial("pendulum", "icem", 3, env=env, policy=fields)
            inputs[name, domain] = run_trial(spec).inputs
    assert np.array_equal(inputs["wide", "box"], inputs["wide", "everywhere"])
    assert not np.array_equal(inputs["narrow", "box"], inputs["narrow", "everywhere"])


def test_the_weight_of_a_state_falls_with_its_distance_from_the_box_on_the_circle() -> None:
    system = SYSTEMS["arm"]()
    domain, half = domain_box(system, "box"), np.array(system.grid_half_widths)
    weight = interpreted(domain_weight)
    assert weight(domain, half) == 1.0
    assert weight(domain, half * [1.25, 1.0, 1.0, 1.0]) == pytest.approx(math.exp(-0.5))
    turned = half + np.array([2 * math.pi, 0.0, -2 * math.pi, 0.0])
    assert weight(domain, turned) == pytest.approx(1.0)


def circle(gamma: float, m: int) -> Array:
    angles = np.linspace(0.0, 2 * np.pi, 721)
    two = gamma * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return two if m == 2 else np.array([[gamma], [-gamma]])


@pytest.mark.parametrize("information_of", ["accumulated", "ekf"])
@pytest.mark.parametrize("env", ["pendulum", "quadrotor"])
def test_no_input_on_the_sphere_gains_more(env: str, information_of: str) -> None:
    """By log det(M + JᵀJ/ρ) of whole matrices; a filter shares its M with the plan."""
    filters, rho = information_of == "ekf", 0.1 if information_of == "ekf" else 1.0
    learner = {"name": "ekf", "noise_variance": rho} if filters else {"name": "adam"}
    given, small = {"regularization": 0.1}, {"width": 3, "depth": 1}
    spec = trial(env, "gradient", 2, env={"horizon": 8}, policy=given, model=small, learner=learner)
    run = trace(spec)
    for t in (1, 4, 7):
        M, theta = information(spec, run, t, 0.1), run.parameters[t]
        if filters:  # which takes the rows before it learns
            before = run.parameters[:t], run.states[:t]
            rows = [jacobian(spec, p, x[None])[0] for p, x in zip(*before, strict=True)]
            M = 0.1 * np.eye(len(M)) + sum(J.T @ J for J in rows) / rho
        inputs = run.inputs[t], *circle(spec.system.gamma, spec.system.n_inputs)
        states = np.array([model_step(spec, theta, run.states[t], u) for u in inputs])
        J = jacobian(spec, theta, states)
        found, *scan = np.linalg.slogdet(M + J.mT @ J / rho)[1]
        assert np.linalg.norm(run.inputs[t]) == pytest.approx(spec.system.gamma)
        assert found >= max(scan) - 1e-3 * np.ptp(scan)


@pytest.mark.parametrize("seed", range(2))
def test_the_d_optimal_policy_recovers_the_linear_one_exactly(seed: int) -> None:
    """Section 2: "we recover the D-optimal exploration algorithm of [7]"."""
    parts = {"policy": {"regularization": 1e-3}, "model": {"name": "linear_state"}}
    parts |= {"env": {"horizon": 80}, "learner": {"name": "recursive_least_squares"}}
    general, closed = (
        run_trial(trial("mass_spring", policy, seed, **parts)) for policy in ("d_optimal", "linear")
    )
    assert closed.inputs == pytest.approx(general.inputs, rel=0.0, abs=1e-7)
    assert closed.states == pytest.approx(general.states, rel=0.0, abs=1e-7)
    assert closed.loss == pytest.approx(general.loss, rel=1e-5)
    assert len(np.unique(closed.inputs.round(6), axis=0)) > 50


def test_the_linear_policy_takes_linear_systems_and_the_linear_model() -> None:
    assert [name for name, system in SYSTEMS.items() if is_linear(system())] == ["mass_spring"]
    with pytest.raises(IncompatibleError, match="policy 'linear' needs dynamics that are linear"):
        trial("arm", "linear")
    with pytest.raises(IncompatibleError, match="goes with model 'linear_state'"):
        trial("mass_spring", "linear", model={"name": "rff"})
