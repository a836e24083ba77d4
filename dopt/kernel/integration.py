"""Steps of the true system and of the model, and what is observed of them, in compiled code.

Sizes of paths beside :mod:`dopt.kernel.structs`: H steps, n paths.
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import RUNGE_KUTTA_SHARES, RUNGE_KUTTA_WEIGHTS, Integrator
from dopt.kernel import network as nn
from dopt.kernel.compiler import called_from_python, compiled, copy_into
from dopt.kernel.held import HeldTrial, trial_in
from dopt.kernel.model import model_accelerations, model_point, plant_point, sampled_state
from dopt.kernel.structs import Network, Plant, Trial
from dopt.types import Matrix, Stack, Vector


@compiled
def n_stages(plant: Plant) -> int:
    """Return the number of derivatives that a step evaluates."""
    return 1 if plant.integrator == Integrator.EULER else 4


@compiled
def write_rate(plant: Plant, x: Vector, u: Vector, accelerations: Vector, rate: Vector) -> None:
    """Write known(x, u) + E a, (d,), given the accelerations, (r,)."""
    plant.known(x, u, plant.parameters, rate)
    for k in range(accelerations.shape[0]):
        rate[plant.learned_rows[k]] += accelerations[k]


@compiled
def add_stage(
    plant: Plant, stage: int, dt: float, x: Vector, rate: Vector, total: Vector, at: Vector
) -> None:
    """Add the derivative of a stage to the mean, (d,), and write where the next one is asked for.

    After the last stage that is the state dt seconds after x.
    """
    if plant.integrator == Integrator.EULER:
        for i in range(x.shape[0]):
            total[i] = rate[i]
            at[i] = x[i] + dt * rate[i]
        return
    weight = RUNGE_KUTTA_WEIGHTS[stage]
    for i in range(x.shape[0]):
        total[i] = weight * rate[i] + (total[i] if stage > 0 else 0.0)
        if stage < 3:
            at[i] = x[i] + RUNGE_KUTTA_SHARES[stage] * dt * rate[i]
        else:
            at[i] = x[i] + dt * total[i]


@compiled
def next_true_state(
    plant: Plant, parameters: Vector, x: Vector, u: Vector, following: Vector
) -> None:
    """Write the state that follows with the true accelerations."""
    rate, total = np.empty(x.shape[0]), np.empty(x.shape[0])
    accelerations = np.empty(plant.learned_rows.shape[0])
    copy_into(x, following)
    for stage in range(n_stages(plant)):
        plant.accelerations(plant_point(plant, following, u), parameters, accelerations)
        write_rate(plant, following, u, accelerations, rate)
        add_stage(plant, stage, plant.dt, x, rate, total, following)


@compiled
def next_model_state(
    plant: Plant,
    network: Network,
    theta: Vector,
    x: Vector,
    u: Vector,
    dt: float,
    following: Vector,
) -> None:
    """Write the state that follows dt seconds later with the accelerations of the model."""
    rate, total = np.empty(x.shape[0]), np.empty(x.shape[0])
    accelerations = np.empty(plant.learned_rows.shape[0])
    copy_into(x, following)
    for stage in range(n_stages(plant)):
        model_accelerations(
            plant, network, theta, model_point(network, following, u), accelerations
        )
        write_rate(plant, following, u, accelerations, rate)
        add_stage(plant, stage, dt, x, rate, total, following)


@compiled
def observe_euler(trial: Trial, t: int, dt: float, target: Vector) -> None:
    """Write the accelerations observed from x_t to x_{t+1}, (r,), after dt seconds."""
    write_difference(trial, t, dt, np.empty(trial.record.states.shape[1]), target)


@compiled
def observe_runge_kutta(trial: Trial, t: int, dt: float, target: Vector) -> None:
    """Write the accelerations observed in the middle of the step, (r,), after dt seconds.

    Adds the difference between the model's integrated step and its pointwise acceleration, so that
    a model without error there predicts x_{t+1}.
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


@compiled
def predicted_state(plant: Plant, network: Network, theta: Vector, x: Vector) -> Vector:
    """Return x̄, (d,), the state that follows without input: x + dt f_θ(x, 0) by the Euler map."""
    following = np.empty(x.shape[0])
    next_model_state(plant, network, theta, x, np.zeros(plant.n_inputs), plant.dt, following)
    return following


@compiled
def arrival_state(plant: Plant, network: Network, theta: Vector, x: Vector) -> Vector:
    """Return the state, (d,), in which an input that is chosen at x begins to act.

    It is predicted with the inputs in flight, and is x itself where inputs act at once.
    """
    at = x
    for _ in range(plant.lead):
        at = predicted_state(plant, network, theta, at)
    return at


@compiled
def arrival_columns(plant: Plant, network: Network, theta: Vector, x: Vector) -> Matrix:
    """Return the change of the state by an input in the step in which it begins to act, (m, d).

    Given is the state in which it does. Where inputs act at once these are
    :func:`learned_columns`. Elsewhere a change in flight is moved on: the known part is affine in
    the inputs in flight.
    """
    columns = learned_columns(plant, network, theta, x)
    if plant.lead > 0:
        still, base, moved = np.zeros(plant.n_inputs), np.empty(x.shape[0]), np.empty(x.shape[0])
        plant.known(x, still, plant.parameters, base)
        for _ in range(plant.lead):
            for j in range(columns.shape[0]):
                plant.known(x + columns[j], still, plant.parameters, moved)
                for i in range(x.shape[0]):
                    columns[j, i] += plant.dt * (moved[i] - base[i])
    return columns


@compiled
def input_columns(plant: Plant, x: Vector) -> Matrix:
    """Return the rows of Bᵀ = dt (∂known/∂u)ᵀ, (m, d), at a state; the known part is affine."""
    base, u = np.empty(x.shape[0]), np.zeros(plant.n_inputs)
    plant.known(x, u, plant.parameters, base)
    columns = np.empty((plant.n_inputs, x.shape[0]))
    for j in range(plant.n_inputs):
        u[j] = 1.0
        plant.known(x, u, plant.parameters, columns[j])
        u[j] = 0.0
        for i in range(x.shape[0]):
            columns[j, i] = plant.dt * (columns[j, i] - base[i])
    return columns


@compiled
def learned_columns(plant: Plant, network: Network, theta: Vector, x: Vector) -> Matrix:
    """Return the rows of Bᵀ = dt (∂f_θ/∂u)ᵀ, (m, d), at a state.

    What a model has learned of the inputs is taken as its secant between -γ and γ along each axis,
    exact for one that is affine in them.
    """
    columns = input_columns(plant, x)
    if network.n_inputs_read == 0:
        return columns
    r, gamma = plant.learned_rows.shape[0], plant.gamma
    ahead, behind, u = np.empty(r), np.empty(r), np.zeros(plant.n_inputs)
    for j in range(plant.n_inputs):
        u[j] = gamma
        model_accelerations(plant, network, theta, model_point(network, x, u), ahead)
        u[j] = -gamma
        model_accelerations(plant, network, theta, model_point(network, x, u), behind)
        u[j] = 0.0
        for k in range(r):
            slope = (ahead[k] - behind[k]) / (2.0 * gamma)
            columns[j, plant.learned_rows[k]] += plant.dt * slope
    return columns


@compiled
def point_columns(network: Network, columns: Matrix) -> Matrix:
    """Return the columns of B as rows, (m, d), with zeros behind them, (m, d + m), for inputs.

    They are the change of the next point by the input, on which the one after it does not depend.
    """
    m, d = columns.shape
    if network.n_inputs_read == 0:
        return columns
    out = np.zeros((m, d + m))
    for j in range(m):
        copy_into(columns[j], out[j, :d])
    return out


@called_from_python
def follow_equations(held: HeldTrial, parameters: Vector, inputs: Stack, states: Stack) -> None:
    """Write the states, (H + 1, n, d), that follow the first under inputs (H, n, m)."""
    plant: Plant = trial_in(held)
    for t in range(inputs.shape[0]):
        for i in range(inputs.shape[1]):
            next_true_state(plant, parameters, states[t, i], inputs[t, i], states[t + 1, i])


@called_from_python
def follow_network(
    held: HeldTrial, network: Network, thetas: Matrix, inputs: Stack, states: Stack
) -> None:
    """Write the states, (H + 1, n, d), that follow the first under inputs (H, n, m).

    They follow the mean of the networks with parameters ``thetas``, (E, q).
    """
    plant: Plant = trial_in(held)
    n, d, r = inputs.shape[1], states.shape[2], plant.learned_rows.shape[0]
    depth, width = network.offsets.shape[0] - 1, network.sizes[1]
    rate, value, total = np.empty(d), np.empty(r), np.empty((n, d))
    features, outputs = np.empty((network.feature_kinds.shape[0], n)), np.empty((r, n))
    one = np.empty((r, n))
    hidden = np.empty((depth, width * n))
    for t in range(inputs.shape[0]):
        states[t + 1] = states[t]
        for stage in range(n_stages(plant)):
            points = np.concatenate((states[t + 1], inputs[t]), axis=1)
            nn.write_features(network, points, features)
            nn.mean_forward(network, thetas, features, hidden, outputs, one)
            for i in range(n):
                x, following = states[t, i], states[t + 1, i]
                for k in range(r):
                    value[k] = outputs[k, i]
                write_rate(plant, following, inputs[t, i], value, rate)
                add_stage(plant, stage, plant.dt, x, rate, total[i], following)
