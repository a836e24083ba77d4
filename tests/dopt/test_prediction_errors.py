"""Fits of the parameters to all that was measured, by the errors of predictions."""

from __future__ import annotations

import numpy as np

from dopt.kernel.learners.joint_kalman import run_filter
from dopt.kernel.run import KernelTrial
from dopt.randomness import draw
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.kernel.calls import call
from tests.dopt.oracles.traces import model_step
from tests.dopt.test_sensors import ANGLE, DEGREE, sensed


def finished(spec: TrialSpec) -> KernelTrial:
    fast = KernelTrial(spec)
    fast.advance(spec.system.horizon)
    return fast


def objective(fast: KernelTrial) -> float:
    """Return Σ (e²/s + log s) + λ‖θ - θ₀‖² at the present parameters, λ being the policy's."""
    theta, prior, n = fast.state.theta, fast.state.prior, fast.done
    total = call(run_filter, fast.trial, n, np.empty((0, len(theta))), np.empty(0))
    return float(total + 3.0 * np.sum((theta - prior) ** 2))


def test_a_fit_finds_parameters_at_which_all_that_was_measured_is_likelier() -> None:
    objectives = {}
    for steps in (1, 8):
        fast = finished(sensed("pendulum", ANGLE, horizon=60, refit_every=60, steps=steps))
        objectives[steps] = objective(fast)
        if steps == 1:
            fast.state.theta[:] = draw(fast.spec).weights
            objectives[0] = objective(fast)
    assert objectives[8] <= objectives[1] < objectives[0]


def test_rows_of_a_fit_are_derivatives_of_the_innovations() -> None:
    """With the gains held, as in the step of Gauss and Newton."""
    fast = finished(sensed("pendulum", ANGLE, horizon=20, refit_every=1000))
    theta = fast.state.theta.copy()
    rows, found = np.empty((20, len(theta))), np.empty(20)
    call(run_filter, fast.trial, 20, rows, found)
    gains = _gains(fast, theta)
    scale = np.array([s for _, s in gains]) ** -0.5
    assert np.allclose(found, _errors(fast, theta, gains) * scale, rtol=1e-6, atol=1e-8)
    direction = np.random.default_rng(1).standard_normal(len(theta))
    ahead, behind = (_errors(fast, theta + sign * 1e-5 * direction, gains) for sign in (1.0, -1.0))
    expected = -(ahead - behind) / 2e-5 * scale
    np.testing.assert_allclose(rows @ direction, expected, rtol=1e-4, atol=1e-6)


def _gains(fast: KernelTrial, theta: Array) -> list[tuple[Array, float]]:
    """Return the gain and the variance of each step of the filter at some parameters."""
    spec, x, P, found = fast.spec, fast.record.states[0], np.zeros((2, 2)), []
    for t, u in enumerate(fast.record.inputs):
        step = 1e-6 * np.eye(2)
        ends = [[model_step(spec, theta, x + sign * e, u) for e in step] for sign in (1, -1)]
        A = (np.array(ends[0]) - np.array(ends[1])).T / 2e-6
        x = model_step(spec, theta, x, u)
        P = A @ P @ A.T + np.diag([0.0, spec.system.dt**2 * 0.1])
        variance = P[0, 0] + DEGREE**2
        K = P[:, 0] / variance
        found.append((K, variance))
        P = P - np.outer(K, K) * variance
        x = x + K * (fast.state.estimate.outputs[t, 0] - x[0])
    return found


def _errors(fast: KernelTrial, theta: Array, gains: list[tuple[Array, float]]) -> Array:
    x, errors = fast.record.states[0], []
    for t, (K, _) in enumerate(gains):
        x = model_step(fast.spec, theta, x, fast.record.inputs[t])
        error = fast.state.estimate.outputs[t, 0] - x[0]
        errors.append(error)
        x = x + K * error
    return np.array(errors)
