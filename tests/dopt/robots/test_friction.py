"""Friction of joints: derivatives, windows, and intervals that hold at the stop."""

import numpy as np
import pytest

from dopt.robots.friction import (
    CoulombViscous,
    FrictionLearner,
    Network,
    Window,
    boundary,
    half_widths,
)
from dopt.robots.limits import Limits

DT = 0.002


def limits(n: int) -> Limits:
    return Limits(np.tile([-3.0, 3.0], (n, 1)), np.full(n, 2.0), np.full(n, 10.0), np.full(n, 50.0))


@pytest.mark.parametrize("model", [CoulombViscous(3), Network(3, seed=1)])
def test_derivatives_are_limits_of_differences(model: CoulombViscous | Network) -> None:
    random, step = np.random.default_rng(0), 1e-6
    parameters = model.start + 0.1 * random.standard_normal(model.start.shape)
    x = random.uniform(-1.0, 1.0, (3, 5))
    x[:, 0] = 0.002
    J = model.jacobian(parameters, x)
    for k in range(model.start.shape[1]):
        moved = np.zeros_like(parameters)
        moved[:, k] = step
        difference = model.torques(parameters + moved, x) - model.torques(parameters - moved, x)
        np.testing.assert_allclose(J[..., k], difference / (2 * step), atol=1e-6)


def test_a_window_is_exact_where_torque_accelerates_a_mass() -> None:
    random, window = np.random.default_rng(1), Window(DT)
    torques = random.standard_normal((len(window.weights), 2))
    q, v = np.zeros((len(torques), 2)), np.array([0.3, -0.1])
    for i in range(1, len(torques)):
        q[i] = q[i - 1] + DT * v + 0.5 * DT**2 * torques[i - 1]
        v = v + DT * torques[i - 1]
    _, _, acceleration, torque = window.means(q, torques)
    assert window.weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(acceleration, torque, rtol=1e-9)


def test_the_boundary_holds_at_all_times_and_not_much_more() -> None:
    random, a, m = np.random.default_rng(2), boundary(0.05), 100
    sums = np.cumsum(random.standard_normal((1000, 4000)), axis=1)
    times = np.arange(1.0, 4001.0)
    half = half_widths(1 / np.sqrt(times), np.full(4000, float(m)), a)
    missed = (np.abs(sums / times) > half).any(axis=1).mean()
    assert 0.015 < missed < 0.05
    assert half[m - 1] * np.sqrt(m) < 1.5 * 1.96


def nothing(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:  # noqa: ARG001  # a body
    return 0.0 * q


def learned(
    seed: int, friction: str = "coulomb_viscous", n: int = 2
) -> tuple[FrictionLearner, np.ndarray]:
    """Learn a linear friction of n joints from windows until the curves are known to 5 %."""
    random = np.random.default_rng(seed)
    known = limits(n)
    learner = FrictionLearner(known, nothing, friction)
    truth = np.column_stack(
        [random.uniform(0.02, 0.06, n), random.uniform(0.01, 0.05, n), np.zeros((n, 3))]
    )
    phases = random.uniform(0, 2 * np.pi, n)
    for step in range(900):
        x = random.choice([0.03, 0.1, 0.4, 0.9], n) * random.choice([-1.0, 1.0], n)
        q = random.uniform(-3, 3, n)
        torque = CoulombViscous(n).torques(truth, x[:, None])[:, 0]
        torque += 0.005 * np.sin(17 * q + phases) + 0.003 * random.standard_normal(n)
        learner.learn((q, x * known.velocity, 0 * x, torque * known.torque))
        if step % 50 < 49:
            continue
        half = learner.intervals()[1]
        if (half[:, :-2].max(axis=1) < 0.05 * learner.sizes()).all():
            break
    return learner, truth


def test_intervals_hold_at_a_stop_that_the_samples_decide() -> None:
    held = []
    for seed in range(5):
        learner, truth = learned(seed, n=40)
        values, half = learner.intervals()
        held.append(np.abs(values[:, -2:] - truth[:, :2]) <= half[:, -2:])
    # 400 intervals of 200 joints: 0.93 is two standard errors below 0.95.
    assert np.mean(held) >= 0.93


def test_a_network_learns_the_curve_of_dry_and_viscous_friction() -> None:
    learner, truth = learned(3, "network")
    speeds = np.array([0.04, 0.2, 0.8])
    expected = CoulombViscous(2).torques(truth, np.tile(speeds, (2, 1)))
    for joint in range(2):
        mean, low, high = learner.curve(joint, speeds * 2.0)
        np.testing.assert_allclose(mean / 50.0, expected[joint], atol=0.1 * expected.max())
        assert (low < mean).all()
        assert (mean < high).all()


def test_slow_windows_teach_nothing() -> None:
    learner = FrictionLearner(limits(2), nothing)
    before = learner.covariance.copy()
    slow = learner.learn((np.zeros(2), np.array([0.001, 1.0]), np.zeros(2), np.ones(2)))
    assert np.isnan(slow[0])
    assert np.isfinite(slow[1])
    np.testing.assert_array_equal(learner.covariance[0], before[0])
    assert (learner.covariance[1] != before[1]).any()


def test_a_joint_that_sticks_while_its_reference_moves_teaches_nothing() -> None:
    """Once its torque counted as friction, which was learned too large and drove light joints."""
    learner = FrictionLearner(limits(3), nothing)
    rates = np.tile([0.2, 0.2, 0.2], (learner.window.size, 1))
    means = np.zeros(3), np.array([0.004, 0.2, -0.2]), np.zeros(3), np.full(3, 5.0)
    found = learner.learn(means, rates)
    np.testing.assert_array_equal(np.isnan(found), [True, False, True])
