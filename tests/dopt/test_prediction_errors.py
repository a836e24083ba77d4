"""Fits of the parameters to all that was measured, by the errors of predictions."""

from __future__ import annotations

from typing import Any

import numpy as np

from dopt.randomness import draw
from dopt.reference.batch import Lockstep
from dopt.types import Array
from tests.dopt.test_sensors import ANGLE, DEGREE, sensed


def test_a_fit_finds_parameters_at_which_all_that_was_measured_is_likelier() -> None:
    """Its objective is that of the reference's pass over all steps."""
    objectives = {}
    for steps in (1, 8):
        spec = sensed("pendulum", ANGLE, horizon=60, path="reference", refit_every=60, steps=steps)
        batch = Lockstep([spec])
        for t in range(60):
            batch.step(t)
        learner: Any = batch.learner
        objectives[steps] = float(learner._run(60)[0])
        if steps == 1:
            batch.theta.copy_(batch.tensor(draw(spec).weights)[None])
            objectives[0] = float(learner._run(60)[0])
    assert objectives[8] <= objectives[1] < objectives[0]


def test_rows_of_a_fit_are_derivatives_of_the_innovations() -> None:
    """With the gains held, as in the step of Gauss and Newton."""
    spec = sensed("pendulum", ANGLE, horizon=20, path="reference", refit_every=1000)
    batch = Lockstep([spec])
    for t in range(20):
        batch.step(t)
    learner: Any = batch.learner
    _, rows, _ = learner._run(20)
    theta, rng = batch.theta.clone(), np.random.default_rng(1)
    direction = batch.tensor(rng.standard_normal(theta.shape[1]))[None]
    gains = _gains(learner, batch)
    ahead, behind = (_errors(batch, theta + sign * 1e-5 * direction, gains) for sign in (1.0, -1.0))
    scale = np.array([float(s) for _, s in gains]) ** -0.5
    expected = -(ahead - behind) / 2e-5 * scale
    along = (rows @ direction.unsqueeze(-1)).squeeze().numpy()
    np.testing.assert_allclose(along, expected, rtol=1e-4, atol=1e-6)


def _gains(learner: Any, batch: Lockstep) -> list[tuple[Array, float]]:
    """Return the gain and the variance of each step of the filter at the present parameters."""
    x, P, found = batch.states[:, 0], np.zeros((2, 2)), []
    for t in range(20):
        u, dt = batch.inputs[:, t], batch.system.dt
        A = learner._state_jacobian(batch.theta, x, u, dt)[0].numpy()
        x = batch.learned.next_states(batch.theta, x, u, dt)
        P = A @ P @ A.T + np.diag([0.0, dt**2 * 0.1])
        variance = P[0, 0] + DEGREE**2
        K = P[:, 0] / variance
        found.append((K, variance))
        P = P - np.outer(K, K) * variance
        x = x + batch.tensor(K) * (batch.sensors.outputs[:, t] - x[:, :1])  # type: ignore[union-attr]
    return found


def _errors(batch: Lockstep, theta: Any, gains: list[tuple[Array, float]]) -> Array:
    x, errors = batch.states[:, 0], []
    for t, (K, _) in enumerate(gains):
        x = batch.learned.next_states(theta, x, batch.inputs[:, t], batch.system.dt)
        error = batch.sensors.outputs[:, t] - x[:, :1]  # type: ignore[union-attr]
        errors.append(float(error))
        x = x + batch.tensor(K) * error
    return np.array(errors)
