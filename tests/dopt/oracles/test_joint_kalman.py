"""The filter over state and parameters: one covariance matrix of both, in one piece."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.kernel.run import KernelTrial
from dopt.learning import JointKalman
from dopt.randomness import draw
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.oracles.traces import jacobian, model_step
from tests.dopt.trials import trial


def filtered(spec: TrialSpec, outputs: Array, inputs: Array) -> tuple[Array, Array, Array]:
    """Return states, (T + 1, d), parameters, (T + 1, q), and the last variances, without fits."""
    system, learner, C = spec.system, spec.learner, spec.system.output_rows
    assert isinstance(learner, JointKalman)
    theta, d, dt = draw(spec).weights, system.n_states, system.dt
    q, rho, zeta = len(theta), learner.noise_variance, learner.underweighting
    E = np.zeros((d, system.n_learned))
    E[list(system.learned_rows), range(system.n_learned)] = 1.0
    covariance = np.zeros((d + q, d + q))
    covariance[d:, d:] = np.eye(q) / learner.regularization
    z, states, parameters = np.concatenate([system.initial_state, theta]), [], []
    for y, u in zip(outputs, inputs, strict=True):
        states.append(z[:d])
        parameters.append(z[d:])
        x, theta = z[:d], z[d:]
        J = jacobian(spec, theta, x[None])[0]
        F = np.eye(d + q)
        F[:d, d:] = dt * E @ J
        for j in range(d):
            step = 1e-5 * max(1.0, abs(x[j])) * np.eye(d)[j]
            ends = [model_step(spec, theta, x + sign * step, u) for sign in (1, -1)]
            F[:d, j] = (ends[0] - ends[1]) / (2 * step[j])
        R = rho * np.eye(len(J)) + zeta * J @ covariance[d:, d:] @ J.T
        covariance = F @ covariance @ F.T
        covariance[:d, :d] += dt**2 * E @ R @ E.T
        z = np.concatenate([model_step(spec, theta, x, u), theta])
        H = np.concatenate([C, np.zeros((len(C), q))], axis=1)
        S = H @ covariance @ H.T + np.diag(np.array(system.measurement_noise) ** 2)
        gain = covariance @ H.T @ np.linalg.inv(S)
        z = z + gain @ (y - H @ z)
        covariance = covariance - gain @ S @ gain.T
    return np.array([*states, z[:d]]), np.array([*parameters, z[d:]]), np.diag(covariance)


@pytest.mark.parametrize(
    "fields",
    [
        {"measured_states": [0], "measurement_noise": [1e-2]},
        {"measured_states": [0, 2], "measurement_noise": [1e-2, 2e-2]},
        {
            "output_matrix": [1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0, 0.0],
            "measurement_noise": [1e-2, 1e-2],
        },
    ],
)
@pytest.mark.parametrize("underweighting", [0.0, 0.3])
def test_it_is_the_filter_over_both_at_once(
    fields: dict[str, object], underweighting: float
) -> None:
    learner = {"name": "joint_ekf", "noise_variance": 0.1, "regularization": 2.0}
    learner |= {"refit_every": 1000, "underweighting": underweighting}
    env, small = {"horizon": 15} | fields, {"width": 3, "depth": 1}
    spec = trial("arm", "random", 4, env=env, model=small, learner=learner)
    run = KernelTrial(spec)
    run.advance(15)
    outputs = run.record.true_states[1:] @ spec.system.output_rows.T + draw(spec).measurement_noise
    states, parameters, _ = filtered(spec, outputs, run.record.inputs)
    assert run.record.states == pytest.approx(states, abs=1e-7)
    assert run.parameters == pytest.approx(parameters[-1], abs=1e-7)
