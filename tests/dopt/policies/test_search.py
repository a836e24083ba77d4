"""Candidate inputs, plans and scores of the policies that search, by their definitions."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from dopt.errors import IncompatibleError, SpecificationError
from dopt.exploration import run_trial
from dopt.planning.task_states import goal_weights, task_states
from dopt.policies import Exact, Lookahead, TaskOptimal
from dopt.policies.lookahead import PERIOD_SHARE, STEPS_WITHOUT_PERIOD
from dopt.policies.search import sphere_directions
from dopt.spec import Cell
from dopt.systems import SYSTEMS
from dopt.systems.equilibrium import eigenmode
from tests.dopt.trials import trial


@pytest.mark.parametrize("m", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("count", [1, 2, 8, 33])
def test_directions_are_unit_vectors_and_always_the_same(m: int, count: int) -> None:
    found = sphere_directions(m, count)
    assert found.shape == (2 if m == 1 else count, m)
    assert np.linalg.norm(found, axis=1) == pytest.approx(1.0, rel=1e-12)
    assert np.array_equal(found, sphere_directions.__wrapped__(m, count))


def test_two_inputs_have_directions_at_equal_angles() -> None:
    found = sphere_directions(2, 16)
    cos, sin = np.cos(np.pi / 8), np.sin(np.pi / 8)
    turned = found @ np.array([[cos, sin], [-sin, cos]])
    assert turned == pytest.approx(np.roll(found, -1, axis=0), abs=1e-12)


@pytest.mark.parametrize(
    ("m", "count", "best"),
    [
        (3, 4, np.arccos(-1 / 3)),
        (3, 6, np.pi / 2),
        (3, 12, np.arccos(1 / 5**0.5)),
        (4, 8, np.pi / 2),
    ],
)
def test_more_inputs_have_directions_nearly_as_far_apart_as_can_be(
    m: int, count: int, best: float
) -> None:
    """Tetrahedron, octahedron, icosahedron and 16-cell are the optimal codes of their size."""
    found = sphere_directions(m, count)
    angles = np.arccos(np.clip(found @ found.T - 2 * np.eye(count), -1, 1))
    assert angles.min() > 0.9 * best


@pytest.mark.parametrize("env", SYSTEMS)
def test_candidates_have_the_largest_norm(env: str) -> None:
    system = SYSTEMS[env]()
    candidates = Exact(directions=12).candidates(system)
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
    assert Lookahead(horizon=7).steps(system) == 7
    assert Lookahead(horizon=27).stride_of(system) == 5
    assert Lookahead(horizon=27, stride=2).stride_of(system) == 2
    assert Lookahead(horizon=1).stride_of(system) == 1


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
    grid = {tuple(state) for state in system.grid()}
    assert all(tuple(state) in grid for state in task_states(system, TaskOptimal()))
    reachable = task_states(system, TaskOptimal(states="reachable"))
    assert not any(tuple(state) in grid for state in reachable)
    assert len(task_states(system, TaskOptimal(count=10**6))) == len(grid)


@pytest.mark.parametrize(
    ("policy", "fields", "message"),
    [
        ("exact", {"directions": 0}, r"policy\.directions is 0 directions, .* above 0: set it so"),
        ("exact", {"budget_us": -1.0}, r"policy\.budget_us is -1\.0 µs, .* 0 or above"),
        ("exact", {"form": "dual"}, r"form"),
        ("lookahead", {"criterion": "jont"}, r"policy\.criterion .* did you mean 'joint'"),
        ("lookahead", {"horizon": 0}, r"policy\.horizon is 0 steps, .* above 0"),
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
        ("lookahead", {"horizon": 4, "stride": 5}, r"policy\.stride is 5 steps, .* have 4: make"),
    ],
)
def test_a_field_that_does_not_fit_the_system_is_answered_by_one_sentence(
    policy: str, fields: dict[str, Any], message: str
) -> None:
    with pytest.raises(IncompatibleError, match=message):
        trial("pendulum", policy, policy=fields)


def test_the_reference_scores_all_plans_at_once_and_keeps_no_budget() -> None:
    cell = trial("pendulum", "lookahead", policy={"budget_us": 100.0}).cell
    with pytest.raises(IncompatibleError, match=r"budget_us goes with path 'kernel'.*reference"):
        dataclasses.replace(cell, path="reference")


def test_plans_along_a_model_in_the_physical_parametrisation() -> None:
    """What searches runs with least squares of the physical parameters, as the oracle does."""
    oracle = trial("pendulum", "oracle")
    policy = Lookahead(horizon=12, regularization=1e-6)
    cell = Cell(oracle.system, policy, oracle.model, oracle.learner)
    result = run_trial(dataclasses.replace(oracle, cell=cell))
    assert np.isfinite(result.loss).all()
    assert result.loss[-1] < 0.05 * result.loss[0]
