"""Candidate inputs, plans and scores of the policies that search, by their definitions."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from dopt.errors import IncompatibleError, SpecificationError
from dopt.evaluation import evaluation_set, reachable_states
from dopt.policies import Exact, Lookahead, TaskOptimal
from dopt.policies.search import PERIOD_SHARE, STEPS_WITHOUT_PERIOD
from dopt.policies.task_states import goal_weights, task_states
from dopt.run import run_trial
from dopt.spec.config import TrialConfig
from dopt.systems import SYSTEMS
from dopt.systems.properties import eigenmode
from tests.dopt.trials import trial


@pytest.mark.parametrize("env", SYSTEMS)
def test_candidates_have_the_largest_norm(env: str) -> None:
    system = SYSTEMS[env]()
    candidates = Exact(candidates=12).compared_inputs(system)
    assert np.linalg.norm(candidates, axis=1) == pytest.approx(system.gamma, rel=1e-12)


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
    system = SYSTEMS["pendulum"]()
    reachable = {tuple(state) for state in reachable_states(system)}
    box = task_states(system, TaskOptimal(count=10**6))
    assert not any(tuple(state) in reachable for state in box)
    half_widths = np.array(system.grid_half_widths)
    assert np.all(np.abs(box) <= half_widths)
    assert np.all(np.abs(box).max(axis=0) > 0.99 * half_widths)
    named = task_states(system, TaskOptimal(states="reachable"))
    assert all(tuple(state) in reachable for state in named)


def test_a_task_is_not_told_where_the_model_is_judged() -> None:
    system = SYSTEMS["pendulum"]()
    judged = {tuple(state) for state in evaluation_set(system).states}
    assert not any(tuple(state) in judged for state in task_states(system, TaskOptimal()))


def test_of_a_tiny_task_the_nearest_state_is_left() -> None:
    tiny = TaskOptimal(goal=(1.0, 0.0), radius=1e-300)
    system = SYSTEMS["pendulum"]()
    nearest = task_states(system, TaskOptimal(goal=(1.0, 0.0), radius=1e-3, count=1))
    np.testing.assert_allclose(task_states(system, tiny), nearest, atol=0.2)
    assert len(task_states(system, tiny)) == 1


@pytest.mark.parametrize(
    ("policy", "fields", "message"),
    [
        (
            "exact",
            {"candidates": 0},
            r"policy\.candidates is 0 .* from 1 to 2147483647: set policy\.candidates to a whole",
        ),
        ("exact", {"budget_us": -1.0}, r"policy\.budget_us is -1\.0 µs, .* at least 0"),
        ("exact", {"form": "dual"}, r"form"),
        ("lookahead", {"criterion": "jont"}, r"policy\.criterion .* did you mean 'joint'"),
        ("lookahead", {"lookahead": 0}, r"policy\.lookahead is 0 steps, .* 1 to 2147483647: set"),
        ("task", {"states": "gird"}, r"policy\.states .* did you mean 'grid'"),
    ],
)
def test_a_wrong_field_is_answered_by_one_sentence(
    policy: str, fields: dict[str, Any], message: str
) -> None:
    with pytest.raises(SpecificationError, match=message):
        trial("pendulum", policy, policy=fields)


@pytest.mark.parametrize(
    ("policy", "fields", "message"),
    [
        ("task", {"goal": (1.0,)}, r"policy\.goal has 1 entries, .* has 2: give one for each"),
        ("lookahead", {"lookahead": 4, "stride": 5}, r"policy\.stride is 5 steps, .* have 4: make"),
        (
            "lookahead",
            {"lookahead": 31},
            r"policy\.lookahead is 31 steps, but a trial .* has 30: lower",
        ),
        ("max", {"lookahead": 31}, r"policy\.lookahead is 31 steps, but a trial .* has 30: lower"),
    ],
)
def test_a_field_that_does_not_fit_the_system_is_answered_by_one_sentence(
    policy: str, fields: dict[str, Any], message: str
) -> None:
    with pytest.raises(IncompatibleError, match=message):
        trial("pendulum", policy, policy=fields)


def test_the_torch_path_does_not_search() -> None:
    config = trial("pendulum", "lookahead").config
    with pytest.raises(IncompatibleError, match="'lookahead' runs in the compiled kernel alone"):
        dataclasses.replace(config, path="reference")


def test_plans_along_a_model_in_the_physical_parametrisation() -> None:
    """What searches runs with least squares of the physical parameters, as the oracle does."""
    oracle = trial("pendulum", "oracle")
    policy = Lookahead(lookahead=12, regularization=1e-6)
    config = TrialConfig(oracle.system, policy, oracle.model, oracle.learner)
    result = run_trial(dataclasses.replace(oracle, config=config))
    assert np.isfinite(result.loss).all()
    assert result.loss[-1] < 0.05 * result.loss[0]


@pytest.mark.parametrize("policy", ["exact", "trace", "a_optimal", "e_optimal", "task"])
def test_random_features_are_searched_by_their_weights_alone(policy: str) -> None:
    sections = {"model": {"name": "rff"}, "learner": {"name": "recursive_least_squares"}}
    result = run_trial(trial("pendulum", policy, **sections))
    assert np.isfinite(result.loss).all()
    assert np.abs(result.inputs) == pytest.approx(2.0)
