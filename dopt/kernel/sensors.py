"""Measurements in compiled code: sensors, low-pass filters, and a Kalman filter of the state.

The low-pass filter (:mod:`dopt.systems.black_box`) serves learners that do not estimate states;
one step of the Kalman filter with a learned model serves those that do. Functions that every step
of every trial calls are given the parts that they need: passing on a whole trial takes
microseconds.

======  =========================================================  =======
symbol  meaning                                                    shape
======  =========================================================  =======
A       ∂x_{t+1}/∂x_t of the model's step                          d × d
P       covariance of the estimated state, given the parameters    d × d
Ψ       derivative of the estimated state by the parameters        d × q
c       row of C                                                   d
K, s    gain and variance of the innovation of an output           d, 1
======  =========================================================  =======
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.integration import next_model_state
from dopt.kernel.structs import Network, Plant, Sensors, Trial
from dopt.kernel.vectors import add_multiple, inner, product
from dopt.types import Integers, Matrix, Vector


@compiled
def has_sensors(sensors: Sensors) -> bool:
    """Return True if the states are measured with noise."""
    n: int = sensors.output_matrix.shape[0]
    return n > 0


@compiled
def measure(sensors: Sensors, noise: Vector, truth: Vector, outputs: Vector) -> None:
    """Write the outputs at a state, (n,), given it, (d,), and their noise, or rounded to counts."""
    for i in range(outputs.shape[0]):
        value, quantum = inner(sensors.output_matrix[i], truth), sensors.quanta[i]
        if quantum > 0.0:
            outputs[i] = quantum * np.floor(value / quantum + 0.5)
        else:
            outputs[i] = value + noise[i]


@compiled
def estimate_state(trial: Trial, t: int, dt: float) -> None:
    """Write an estimate of x_{t+1}, dt seconds after x_t; row t of ``outputs`` was measured of it.

    A learner that estimates states finds the prediction of its model there.
    """
    sensors, record, estimate = trial.sensors, trial.record, trial.state.estimate
    x, following, u = record.states[t], record.states[t + 1], record.inputs[t]
    estimate.durations[t] = dt
    if sensors.cutoff == 0.0:
        next_model_state(trial.plant, trial.network, trial.state.theta, x, u, dt, following)
    else:
        low_pass(trial, t, dt, following)


@compiled
def low_pass(trial: Trial, t: int, dt: float, following: Vector) -> None:
    """Write the filtered states and differences, (d,), and the filtered input of step t."""
    sensors, estimate = trial.sensors, trial.state.estimate
    states, rates, before = estimate.filtered[0], estimate.filtered[1], estimate.filtered[2]
    if np.isfinite(estimate.starts[t, 0]):
        start_filters(trial, estimate.starts[t])
    share = 1.0 - np.exp(-2.0 * np.pi * sensors.cutoff * dt)
    for i in range(sensors.measured.shape[0]):
        row, y = sensors.measured[i], estimate.outputs[t, i]
        rates[row] += share * ((y - before[row]) / dt - rates[row])
        change, before[row] = share * (y - states[row]), y
        states[row] += change
        following[row] = states[row] - sensors.delay * change
    for i in range(following.shape[0]):
        if sensors.positions[i] != i:
            following[i] = rates[sensors.positions[i]] / sensors.factors[i]
    for j in range(estimate.filtered_input.shape[0]):
        change = share * (trial.record.inputs[t, j] - estimate.filtered_input[j])
        estimate.filtered_input[j] += change
        estimate.inputs[t, j] = estimate.filtered_input[j] - sensors.delay * change
    if trial.plant.n_carried > 0:
        carry(trial.plant, trial.record.states[t], estimate.inputs[t], following)


@compiled
def carry(plant: Plant, x: Vector, u: Vector, following: Vector) -> None:
    """Write the inputs in flight after a step: filtered, as the input u behind them, (m,)."""
    rate = np.empty(x.shape[0])
    plant.known(x, u, plant.parameters, rate)
    for i in range(x.shape[0] - plant.n_carried, x.shape[0]):
        following[i] = x[i] + plant.dt * rate[i]


@compiled
def start_filters(trial: Trial, x: Vector) -> None:
    """Start the filters at a state, (d,), with an input of 0."""
    filtered = trial.state.estimate.filtered
    filtered[0] = x
    filtered[2] = x
    for i in range(x.shape[0]):
        position = trial.sensors.positions[i]
        if position != i:
            filtered[1, position] = trial.sensors.factors[i] * x[i]
    trial.state.estimate.filtered_input[:] = 0.0


@compiled
def output_error(trial: Trial, t: int, dt: float) -> float:
    """Return how far what was measured of x_{t+1} is from what the model predicts.

    It is the Euclidean norm, each output in standard deviations of its noise.
    """
    sensors, outputs = trial.sensors, trial.state.estimate.outputs[t]
    following, square = np.empty(trial.record.states.shape[1]), 0.0
    x, u, network = trial.record.states[t], trial.record.inputs[t], trial.network
    next_model_state(trial.plant, network, trial.state.theta, x, u, dt, following)
    for i in range(outputs.shape[0]):
        error = outputs[i] - inner(sensors.output_matrix[i], following)
        square += error * error / sensors.variances[i]
    return float(np.sqrt(square))


DIFFERENCE = 1e-5
"""Change of a state, relative to its size and 1, over which derivatives are taken."""


@compiled
def state_jacobian(
    plant: Plant, network: Network, theta: Vector, x: Vector, u: Vector, dt: float
) -> Matrix:
    """Return A by central differences."""
    d = x.shape[0]
    A, ahead, behind, at = np.empty((d, d)), np.empty(d), np.empty(d), x.copy()
    for j in range(d):
        step = DIFFERENCE * max(1.0, abs(x[j]))
        at[j] = x[j] + step
        next_model_state(plant, network, theta, at, u, dt, ahead)
        at[j] = x[j] - step
        next_model_state(plant, network, theta, at, u, dt, behind)
        at[j] = x[j]
        for i in range(d):
            A[i, j] = (ahead[i] - behind[i]) / (2.0 * step)
    return A


@compiled
def begin(trial: Trial, t: int, P: Matrix, sensitivity: Matrix) -> bool:
    """Return True if step t begins at a given state; P and Ψ then belong to that state."""
    if not np.isfinite(trial.state.estimate.starts[t, 0]):
        return False
    P[:] = np.diag(trial.sensors.start_variances)
    sensitivity[:] = 0.0
    return True


@compiled
def move_covariance(A: Matrix, noise: Matrix, rows: Integers, dt: float, P: Matrix) -> None:
    """Write A P Aᵀ + dt² E R Eᵀ, given the covariance R of the accelerations, (r, r)."""
    P[:] = product(product(A, P), A.T.copy())
    for k in range(rows.shape[0]):
        for i in range(rows.shape[0]):
            P[rows[k], rows[i]] += dt * dt * noise[k, i]


@compiled
def move_sensitivity(A: Matrix, J: Matrix, rows: Integers, dt: float, sensitivity: Matrix) -> None:
    """Write A Ψ + dt E J, given J, (r, q)."""
    sensitivity[:] = product(A, sensitivity)
    for k in range(rows.shape[0]):
        add_multiple(sensitivity[rows[k]], dt, J[k])


@compiled
def innovation(trial: Trial, t: int, i: int, x: Vector, P: Matrix) -> tuple[float, Vector, float]:
    """Return y - c x of output i after step t at a predicted state, (d,), K, (d,), and s."""
    sensors = trial.sensors
    output, gain = sensors.output_matrix[i], np.empty(P.shape[0])
    for j in range(P.shape[0]):
        gain[j] = inner(P[j], output)
    error = trial.state.estimate.outputs[t, i] - inner(output, x)
    variance = inner(output, gain) + sensors.variances[i]
    gain /= variance
    return error, gain, variance


@compiled
def output_sensitivity(sensitivity: Matrix, output: Vector, row: Vector) -> None:
    """Write c Ψ, (q,), the derivative of an output by the parameters."""
    row[:] = 0.0
    for i in range(output.shape[0]):
        if output[i] != 0.0:
            add_multiple(row, output[i], sensitivity[i])


@compiled
def correct_covariance(P: Matrix, gain: Vector, variance: float) -> None:
    """Write P - K Kᵀ s, given K, (d,)."""
    d = P.shape[0]
    for i in range(d):
        for j in range(d):
            P[i, j] -= gain[i] * gain[j] * variance


@compiled
def correct_sensitivity(gain: Vector, row: Vector, sensitivity: Matrix) -> None:
    """Write Ψ - K c Ψ, given c Ψ, (q,)."""
    for i in range(gain.shape[0]):
        add_multiple(sensitivity[i], -gain[i], row)
