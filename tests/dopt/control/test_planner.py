from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from dopt.control.planning import CrossEntropy, within_ball

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
    planner = CrossEntropy(gamma=5.0, samples=1000, iterations=60, elites=100)
    plan = planner.plan(linear_quadratic_cost, np.zeros((HORIZON, 1)), np.random.default_rng(0))
    best = START @ riccati() @ START
    assert linear_quadratic_cost(riccati_plan()[None])[0] == pytest.approx(best, rel=1e-9)
    assert best <= linear_quadratic_cost(plan[None])[0] <= 1.005 * best
    assert np.sqrt(np.mean((plan - riccati_plan()) ** 2)) < 0.1


def test_a_binding_ball_is_kept_and_used() -> None:
    planner = CrossEntropy(gamma=1.0, samples=200, iterations=40, elites=20)
    target = np.array([3.0, 4.0])
    plan = planner.plan(
        lambda plans: np.sum((plans - target) ** 2, axis=(1, 2)),
        np.zeros((5, 2)),
        np.random.default_rng(1),
    )
    np.testing.assert_allclose(plan, np.tile([0.6, 0.8], (5, 1)), atol=0.08)
    assert np.all(np.linalg.norm(plan, axis=1) <= 1.0 + 1e-12)


def test_costs_that_overflow_are_the_worst() -> None:
    planner = CrossEntropy(gamma=1.0, samples=64, iterations=10, elites=8)

    def cost(plans: np.ndarray) -> np.ndarray:
        first = plans[:, 0, 0]
        return np.where(first > 0.2, np.nan, np.where(first < -0.2, -np.inf, -first))

    plan = planner.plan(cost, np.zeros((1, 1)), np.random.default_rng(2))
    assert plan[0, 0] == pytest.approx(0.2, abs=0.05)


@pytest.mark.parametrize("seed", range(20))
def test_no_sequence_that_was_tried_is_better_than_the_plan(seed: int) -> None:
    planner = CrossEntropy(gamma=1.0, samples=16, iterations=3, elites=8)
    costs: list[float] = []

    def cost(plans: np.ndarray) -> np.ndarray:
        found = np.cos(7 * plans).sum(axis=(1, 2))  # the mean of two optima is none
        costs.extend(found)
        return np.asarray(found)

    plan = planner.plan(cost, np.zeros((3, 2)), np.random.default_rng(seed))
    assert np.cos(7 * plan).sum() == min(costs)


def test_a_warm_start_that_is_the_optimum_is_kept_in_sight() -> None:
    planner = CrossEntropy(gamma=1.0, samples=2, iterations=1, elites=1)
    best = np.full((30, 1), 0.123)
    plan = planner.plan(
        lambda plans: np.sum((plans - best) ** 2, axis=(1, 2)), best, np.random.default_rng(3)
    )
    np.testing.assert_array_equal(plan, best)


def test_inputs_inside_the_ball_stay_as_they_are() -> None:
    inputs = np.array([[0.3, 0.4], [0.0, 0.0], [3.0, 4.0]])
    np.testing.assert_allclose(within_ball(inputs, 1.0), [[0.3, 0.4], [0.0, 0.0], [0.6, 0.8]])
