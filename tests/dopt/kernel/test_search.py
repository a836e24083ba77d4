"""Policies that search, against dense linear algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch.func import jacrev, vmap

from dopt.kernel.linear_algebra import dense
from dopt.kernel.run import KernelTrial
from dopt.policies import Search, TaskOptimal
from dopt.policies.task_states import task_states
from dopt.randomness import draw
from dopt.reference.models import model_function
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from tests.dopt.torch_models import for_one
from tests.dopt.trials import trial

SEARCHES: list[tuple[str, dict[str, Any]]] = [
    ("exact", {}),
    ("trace", {}),
    ("a_optimal", {}),
    ("e_optimal", {"subspace": 12}),
    ("task", {"count": 5}),
    ("lookahead", {"lookahead": 7, "criterion": "joint"}),
    ("lookahead", {"lookahead": 8, "criterion": "sum", "stride": 2}),
]


def before_planning(spec: TrialSpec, steps: int) -> KernelTrial:
    """Return a trial whose next step is planned from what it holds."""
    fast = KernelTrial(spec)
    fast.advance(steps)
    return fast


def rows_of_candidates(fast: KernelTrial) -> tuple[np.ndarray, np.ndarray]:
    """Return the candidates, (C, m), and J at the states that they lead to, (C, r, q)."""
    system, policy = fast.spec.system, fast.spec.policy
    assert isinstance(policy, Search)
    candidates = policy.compared_inputs(system)
    x, theta = fast.record.states[fast.done], fast.state.theta
    learned = fast.spec.model.predict(system, theta, x[None])[0]
    states = []
    for u in candidates:
        flow = np.array(system.known(tuple(x), tuple(u), system.parameters))
        flow[list(system.learned_rows)] += learned
        states.append(x + system.dt * flow)
    return candidates, jacobian(fast, np.stack(states))


def jacobian(fast: KernelTrial, states: np.ndarray) -> np.ndarray:
    """Return J at states, (N, r, q), by automatic differentiation."""
    model = model_function(fast.spec.system, fast.spec.model)
    rows = vmap(jacrev(for_one(model)), (None, 0))(
        torch.tensor(fast.state.theta), torch.tensor(states)
    )
    return np.asarray(rows)


def worth(policy: str, fast: KernelTrial, M: np.ndarray, J: np.ndarray) -> float:
    """Return what the rows J are worth, from M + JᵀJ by dense linear algebra."""
    grown = M + J.T @ J
    if policy == "exact":
        return float(np.linalg.slogdet(grown)[1])
    if policy == "trace":
        return float(np.trace(J @ np.linalg.solve(M, J.T)))
    if policy == "a_optimal":
        return -float(np.trace(np.linalg.inv(grown)))
    if policy == "e_optimal":
        return float(np.linalg.eigvalsh(grown)[0])
    assert isinstance(fast.spec.policy, TaskOptimal)
    G = jacobian(fast, task_states(fast.spec.system, fast.spec.policy)).reshape(-1, len(M))
    return -float(np.trace(G @ np.linalg.solve(grown, G.T)))


@pytest.mark.parametrize("policy", ["exact", "trace", "a_optimal", "e_optimal", "task"])
@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm", "quadrotor"])
@pytest.mark.parametrize("steps", [1, 20, 45])
def test_no_candidate_is_better_than_the_chosen_one(env: str, policy: str, steps: int) -> None:
    """With few parameters all directions are known after a while: no eigenvalue is that of M₀."""
    fields = {"subspace": 10_000} if policy == "e_optimal" else {}
    small = {"width": 3, "depth": 1}
    spec = trial(env, policy, 5, env={"horizon": 50}, policy=fields, model=small)
    fast = before_planning(spec, steps)
    M = np.linalg.inv(dense(fast.state.covariance))
    candidates, rows = rows_of_candidates(fast)
    values = np.array([worth(policy, fast, M, J) for J in rows])
    fast.advance(steps + 1)
    chosen = np.flatnonzero((candidates == fast.record.inputs[steps]).all(axis=1))
    assert len(chosen) == 1
    slack = 1e-7 * (values.max() - values.min()) + 1e-9 * abs(values).max()
    assert values[chosen[0]] >= values.max() - slack


@pytest.mark.parametrize("policy", ["exact", "trace", "trace_linearized"])
def test_with_one_input_and_a_short_step_the_sign_is_that_of_d_optimal(policy: str) -> None:
    """For dt → 0 the linearisation in u is exact, and one component has one variance."""
    env = {"horizon": 40, "dt": 1e-5}
    found = run_trial(trial("pendulum", policy, 2, env=env)).inputs
    expected = run_trial(trial("pendulum", "d_optimal", 2, env=env)).inputs
    assert np.array_equal(found, expected)


@pytest.mark.parametrize("criterion", ["joint", "sum"])
@pytest.mark.parametrize("env", ["pendulum", "quadrotor"])
def test_a_plan_of_one_step_is_one_step_of_exact(env: str, criterion: str) -> None:
    fields = {"lookahead": 1, "criterion": criterion, "candidates": 6}
    ahead = run_trial(trial(env, "lookahead", 4, policy=fields))
    exact = run_trial(trial(env, "exact", 4, policy={"candidates": 6}))
    assert np.array_equal(ahead.inputs, exact.inputs)


def test_all_components_at_once_are_one_component_where_there_is_one() -> None:
    found = run_trial(trial("pendulum", "trace_linearized", 1))
    assert np.array_equal(found.inputs, run_trial(trial("pendulum", "d_optimal", 1)).inputs)


def test_plans_that_leave_the_bounds_of_a_state_do_not_count() -> None:
    limit = 0.5
    env = {"horizon": 60, "state_limit": limit, "gamma": 1.0}
    careful = trial("pendulum", "lookahead", 1, env=env, policy={"lookahead": 4})
    fast = run_trial(careful)
    reckless = run_trial(trial("pendulum", "lookahead", 1, env=env | {"state_limit": 1e4}))
    assert np.abs(reckless.states).max() > limit
    assert fast.diverged_at is None


def test_where_every_plan_leaves_the_bounds_chance_decides() -> None:
    env = {"horizon": 40, "state_limit": 0.1, "gamma": 1.0}
    spec = trial("pendulum", "lookahead", 1, env=env, policy={"lookahead": 12})
    fast = run_trial(spec)
    end = fast.diverged_at
    assert end is not None
    assert np.array_equal(np.sign(fast.inputs[1:end]), np.sign(draw(spec).ties[1:end]))


class TestBudget:
    FIELDS: dict[str, Any] = {"lookahead": 10, "candidates": 8}  # noqa: RUF012  # read only

    def spec(self, budget_us: float) -> TrialSpec:
        return trial("quadrotor", "lookahead", 2, policy=self.FIELDS | {"budget_us": budget_us})

    def test_it_is_kept_but_for_one_plan(self) -> None:
        unlimited, limited = run_trial(self.spec(0.0)), run_trial(self.spec(1_000.0))
        plan = np.median(unlimited.plan_us[1:]) / 64
        assert np.median(limited.plan_us[1:]) < 1_000.0 + 20 * plan
        assert np.median(limited.plan_us[1:]) < np.median(unlimited.plan_us[1:])

    def test_without_time_the_input_nearest_to_a_random_direction_is_taken(self) -> None:
        spec = self.spec(1e-9)
        assert isinstance(spec.policy, Search)
        candidates = spec.policy.compared_inputs(spec.system)
        nearest = np.argmax(draw(spec).ties @ candidates.T, axis=1)
        assert np.array_equal(run_trial(spec).inputs[1:], candidates[nearest][1:])

    def test_with_time_enough_all_plans_are_scored(self) -> None:
        assert np.array_equal(run_trial(self.spec(1e9)).inputs, run_trial(self.spec(0.0)).inputs)
