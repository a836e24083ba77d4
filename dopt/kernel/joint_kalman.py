"""Kalman filter over state and parameters in compiled code (:mod:`dopt.learning.online`).

Its numbers are λ, the ρ of the beginning, ζ, the steps from one fit to the next, the Gauss-Newton
steps of a fit, and whether it estimates ρ.

A fit goes by the errors of predictions of all that was measured. The filter over the state alone,
at parameters θ, leaves the innovations e, whose variances are s; their derivatives by θ, with the
gains held, are -C Ψ. A fit takes damped Gauss-Newton steps to the minimum of
Σ (e²/s + log s) + λ ‖θ - θ₀‖².
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import NO_GROWTH, SMALLEST_SHARE
from dopt.kernel.compiler import compiled
from dopt.kernel.integration import next_model_state
from dopt.kernel.learners import filter_step, sampled_point, squared_distance
from dopt.kernel.linear_algebra import factorize, quadratic_forms, replaced, solve, write_inverse
from dopt.kernel.model import model_point, model_rows, state_between
from dopt.kernel.sensors import (
    begin,
    correct_covariance,
    correct_sensitivity,
    innovation,
    move_covariance,
    move_sensitivity,
    output_sensitivity,
    state_jacobian,
)
from dopt.kernel.structs import Trial
from dopt.kernel.vectors import add_symmetric, inner, multiply
from dopt.types import Matrix, Vector

NOISE_FACTORS = (10.0**0.25, 10.0**-0.25)
"""Factors by which a fit moves the variance of the accelerations as long as that is likelier."""

MOST_NOISE_FACTORS = 8
"""Moves of one fit by each factor, two decades in all."""


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
    """Move P and Ψ from x_t to x_{t+1}, whose estimate holds the prediction."""
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
        error, gain, variance = innovation(trial, t, i, x, P)
        output_sensitivity(sensitivity, sensors.output_matrix[i], row)
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


@compiled
def fit(trial: Trial, n: int, regularization: float, steps: int, fits_noise: bool) -> None:
    """Fit θ, and ρ if asked to, to what was measured in n steps; rewrite M⁻¹, x̂_n, P and Ψ.

    θ is NaN afterwards, which ends the trial as diverged, where rounding has left M indefinite.
    """
    state = trial.state
    theta, prior, q = state.theta, state.prior, state.theta.shape[0]
    n_errors = n * trial.sensors.output_matrix.shape[0]
    rows, errors, step = np.empty((n_errors, q)), np.empty(n_errors), np.empty(q)
    normal, definite = np.empty((q, q)), True
    for turn in range(steps + 1):
        if turn == steps and fits_noise:
            _fit_noise(trial, n)
        before = run_filter(trial, n, rows, errors)
        before += regularization * squared_distance(theta, prior)
        normal[:] = 0.0
        add_symmetric(rows.T, rows, normal)
        for i in range(q):
            normal[i, i] += regularization
        definite = definite and factorize(normal)
        if not definite:
            break
        if turn < steps:
            multiply(errors.reshape(1, -1), rows, step.reshape(1, -1))
            step += regularization * (prior - theta)
            solve(normal, step)
            _take_step(trial, n, regularization, before, step)
    if not (definite and write_inverse(normal, state.covariance.upper)):
        theta[:] = np.nan
    replaced(state.covariance)


@compiled
def _fit_noise(trial: Trial, n: int) -> None:
    """Move ρ by factors as long as the errors of n steps become likelier, at the present θ."""
    noise, none = trial.state.estimate.noise_variance, np.empty((0, trial.state.theta.shape[0]))
    lowest = run_filter(trial, n, none, np.empty(0))
    for factor in NOISE_FACTORS:
        for _ in range(MOST_NOISE_FACTORS):
            held = noise[0]
            noise[0] = held * factor
            found = run_filter(trial, n, none, np.empty(0))
            if not found < lowest:
                noise[0] = held
                break
            lowest = found


@compiled
def _take_step(trial: Trial, n: int, regularization: float, before: float, step: Vector) -> None:
    """Move θ along a step, (q,), as far as the objective does not grow from ``before``."""
    theta, prior, share = trial.state.theta, trial.state.prior, 1.0
    start, none = theta.copy(), np.empty((0, theta.shape[0]))
    while share >= SMALLEST_SHARE:
        theta[:] = start + share * step
        after = run_filter(trial, n, none, np.empty(0))
        after += regularization * squared_distance(theta, prior)
        if after <= before + (NO_GROWTH - 1.0) * abs(before):
            return
        share *= 0.5
    theta[:] = start


@compiled
def run_filter(trial: Trial, n: int, rows: Matrix, errors: Vector) -> float:
    """Filter what was measured in n steps at the present θ and ρ; return Σ (e²/s + log s).

    Writes C Ψ/√s, (n outputs, q), and e/√s, if there is room for them, and then also x̂_n, P and Ψ.
    """
    plant, network, theta = trial.plant, trial.network, trial.state.theta
    sensors, estimate, with_rows = trial.sensors, trial.state.estimate, rows.shape[0] > 0
    n_measured, r = sensors.output_matrix.shape[0], plant.learned_rows.shape[0]
    x = trial.record.states[0].copy()
    d, noise, following = x.shape[0], estimate.noise_variance[0] * np.eye(r), np.empty(x.shape[0])
    P, sensitivity = np.zeros((d, d)), np.zeros((d, theta.shape[0]))
    row, total = np.empty(theta.shape[0]), 0.0
    for t in range(n):
        u, dt = trial.record.inputs[t], estimate.durations[t]
        if begin(trial, t, P, sensitivity):
            x[:] = estimate.starts[t]
        A = state_jacobian(plant, network, theta, x, u, dt)
        next_model_state(plant, network, theta, x, u, dt, following)
        if with_rows:
            point = model_point(network, state_between(plant, x, following), u)
            J = model_rows(plant, network, theta, point, np.empty(r))
            move_sensitivity(A, J, plant.learned_rows, dt, sensitivity)
        move_covariance(A, noise, plant.learned_rows, dt, P)
        x[:] = following
        for i in range(n_measured):
            error, gain, variance = innovation(trial, t, i, x, P)
            total += error * error / variance + np.log(variance)
            correct_covariance(P, gain, variance)
            if with_rows:
                scale = 1.0 / np.sqrt(variance)
                output_sensitivity(sensitivity, sensors.output_matrix[i], row)
                rows[t * n_measured + i] = scale * row
                errors[t * n_measured + i] = scale * error
                correct_sensitivity(gain, row, sensitivity)
            for j in range(d):
                x[j] += gain[j] * error
    if with_rows:
        trial.record.states[n] = x
        estimate.covariance[:] = P
        estimate.sensitivity[:] = sensitivity
    return total
