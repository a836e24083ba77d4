"""States that are measured with noise, and estimates of them by a filter, in compiled code.

The filter is that of :mod:`dopt.systems.black_box`, for learners that do not estimate states. What
every step of every trial calls is given the parts that it needs: a whole trial takes microseconds
to pass on.
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.information.primal import inner
from dopt.kernel.integration import next_model_state
from dopt.kernel.structs import Sensors, Trial
from dopt.types import Vector


@compiled
def has_sensors(sensors: Sensors) -> bool:
    """Tell whether the states are measured with noise."""
    n: int = sensors.output_matrix.shape[0]
    return n > 0


@compiled
def measure(sensors: Sensors, noise: Vector, truth: Vector, outputs: Vector) -> None:
    """Write the outputs at a state, (n,), given it, (d,), and their noise."""
    for i in range(outputs.shape[0]):
        outputs[i] = inner(sensors.output_matrix[i], truth) + noise[i]


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
            following[i] = rates[sensors.positions[i]]
    for j in range(estimate.filtered_input.shape[0]):
        change = share * (trial.record.inputs[t, j] - estimate.filtered_input[j])
        estimate.filtered_input[j] += change
        estimate.inputs[t, j] = estimate.filtered_input[j] - sensors.delay * change


@compiled
def start_filters(trial: Trial, x: Vector) -> None:
    """Let the filters begin at a state, (d,), with an input of 0."""
    filtered = trial.state.estimate.filtered
    filtered[0] = x
    filtered[2] = x
    for i in range(x.shape[0]):
        position = trial.sensors.positions[i]
        if position != i:
            filtered[1, position] = x[i]
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
