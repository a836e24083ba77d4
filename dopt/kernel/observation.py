"""Accelerations observed in a step, by the integrator of the system, in compiled code."""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.integration import next_model_state
from dopt.kernel.model import model_accelerations
from dopt.kernel.points import model_point, sampled_state
from dopt.kernel.structs import Trial
from dopt.types import Vector


@compiled
def observe_euler(trial: Trial, t: int, dt: float, target: Vector) -> None:
    """Write the accelerations observed from x_t to x_{t+1}, (r,), after dt seconds."""
    write_difference(trial, t, dt, np.empty(trial.record.states.shape[1]), target)


@compiled
def observe_runge_kutta(trial: Trial, t: int, dt: float, target: Vector) -> None:
    """Write the accelerations observed in the middle of the step, (r,), after dt seconds.

    What the model's own step differs from the acceleration that it has there is added to them: a
    model whose error at them is 0 predicts x_{t+1}.
    """
    plant, network, theta = trial.plant, trial.network, trial.state.theta
    x, u = trial.record.states[t], trial.state.estimate.inputs[t]
    value, flow, end = np.empty(target.shape[0]), np.empty(x.shape[0]), np.empty(x.shape[0])
    write_difference(trial, t, dt, flow, target)
    at = sampled_state(plant, trial.record.states, t)
    model_accelerations(plant, network, theta, model_point(network, at, u), value)
    next_model_state(plant, network, theta, x, u, dt, end)
    for k in range(target.shape[0]):
        row = plant.learned_rows[k]
        target[k] -= (end[row] - x[row]) / dt - (flow[row] + value[k])


@compiled
def write_difference(trial: Trial, t: int, dt: float, flow: Vector, target: Vector) -> None:
    """Write the known part of dx/dt at the sampled state, (d,), and what is observed beside it."""
    plant, states = trial.plant, trial.record.states
    x, following = states[t], states[t + 1]
    at = sampled_state(plant, states, t)
    plant.known(at, trial.state.estimate.inputs[t], plant.parameters, flow)
    for k in range(target.shape[0]):
        row = plant.learned_rows[k]
        target[k] = (following[row] - x[row]) / dt - flow[row]
