"""Kalman filter over state and parameters in compiled code (:mod:`dopt.learning.least_squares`).

Its numbers are λ, the ρ of the beginning, ζ, the steps from one fit to the next, the Gauss-Newton
steps of a fit, and whether it estimates ρ.
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.information.primal import inner, quadratic_forms
from dopt.kernel.information.update import filter_step, model_rows
from dopt.kernel.learners.prediction_errors import fit
from dopt.kernel.learners.samples import sampled_point
from dopt.kernel.learners.state_filter import (
    begin,
    correct_covariance,
    correct_sensitivity,
    covariances,
    move_covariance,
    move_sensitivity,
    output_sensitivity,
    state_jacobian,
)
from dopt.kernel.points import model_point
from dopt.kernel.structs import Trial
from dopt.types import Vector


@compiled
def learn(trial: Trial, t: int, target: Vector) -> None:  # noqa: ARG001  # it learns from outputs
    """Filter what was measured of x_{t+1}, and fit all that was measured every k steps."""
    numbers = trial.algorithm.learner
    refit_every, steps = int(numbers[3]), int(numbers[4])
    predict(trial, t, numbers[2])
    update(trial, t)
    if (t + 1) % refit_every == 0:
        fit(trial, t + 1, numbers[0], steps, numbers[5] != 0.0)


@compiled
def predict(trial: Trial, t: int, underweighting: float) -> None:
    """Move P and Ψ from x_t to x_{t+1}, of which the estimate is the prediction already."""
    plant, network, theta = trial.plant, trial.network, trial.state.theta
    estimate, rows = trial.state.estimate, plant.learned_rows
    r, dt = rows.shape[0], estimate.durations[t]
    J = model_rows(plant, network, theta, sampled_point(trial, t), np.empty(r))
    noise = np.zeros((r, r))
    if underweighting > 0.0:
        noise[:] = underweighting * quadratic_forms(trial.state.covariance, J, J)
    for k in range(r):
        noise[k, k] += estimate.noise_variance[0]
    x, u = trial.record.states[t], trial.record.inputs[t]
    begin(trial, t, estimate.covariance, estimate.sensitivity)
    A = state_jacobian(plant, network, theta, x, u, dt)
    move_covariance(A, noise, rows, dt, estimate.covariance)
    move_sensitivity(A, J, rows, dt, estimate.sensitivity)


@compiled
def update(trial: Trial, t: int) -> None:
    """Correct x̂_{t+1} and θ, P, Ψ and M by what was measured, one output after the other."""
    state, sensors = trial.state, trial.sensors
    estimate, x = state.estimate, trial.record.states[t + 1]
    P, sensitivity, q = estimate.covariance, estimate.sensitivity, state.theta.shape[0]
    rows, residual, change = np.empty((1, q)), np.empty(1), np.empty(q)
    row = np.empty(q)
    for i in range(sensors.output_matrix.shape[0]):
        output = sensors.output_matrix[i]
        gain = covariances(P, output)
        error = estimate.outputs[t, i] - inner(output, x)
        variance = inner(output, gain) + sensors.variances[i]
        gain /= variance
        output_sensitivity(sensitivity, output, row)
        scale = 1.0 / np.sqrt(variance)
        rows[0] = scale * row
        residual[0] = scale * error
        change[:] = -state.theta
        filter_step(state.covariance, state.theta, rows, residual)
        change += state.theta
        correct_covariance(P, gain, variance)
        correct_sensitivity(gain, row, sensitivity)
        for j in range(x.shape[0]):
            x[j] += gain[j] * error + inner(sensitivity[j], change)


@compiled
def acceleration_variances(trial: Trial, x: Vector) -> Vector:
    """Return the variances ρ + g M⁻¹ gᵀ of the accelerations at a state without input, (r,)."""
    plant, network, state = trial.plant, trial.network, trial.state
    point = model_point(network, x, np.zeros(plant.n_inputs))
    J = model_rows(plant, network, state.theta, point, np.empty(plant.learned_rows.shape[0]))
    variances: Vector = np.diag(quadratic_forms(state.covariance, J, J)).copy()
    variances += state.estimate.noise_variance[0]
    return variances


@compiled
def state_variances(trial: Trial, t: int) -> Vector:
    """Return the diagonal of P + Ψ M⁻¹ Ψᵀ, the variances of the estimate x̂_t, (d,)."""
    estimate = trial.state.estimate
    if np.isfinite(estimate.starts[t, 0]):
        return trial.sensors.start_variances.copy()
    psi = estimate.sensitivity
    spread = quadratic_forms(trial.state.covariance, psi, psi)
    variances: Vector = np.diag(estimate.covariance) + np.diag(spread)
    return variances
