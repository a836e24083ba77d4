"""Predicted next state and the effect of the inputs on it, in compiled code."""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled, copy_into
from dopt.kernel.integration import next_model_state
from dopt.kernel.model import model_accelerations
from dopt.kernel.points import model_point
from dopt.kernel.structs import Network, Plant
from dopt.types import Matrix, Vector


@compiled
def predicted_state(plant: Plant, network: Network, theta: Vector, x: Vector) -> Vector:
    """Return x̄, (d,), the state that follows without input: x + dt f_θ(x, 0) by the Euler map."""
    following = np.empty(x.shape[0])
    next_model_state(plant, network, theta, x, np.zeros(plant.n_inputs), plant.dt, following)
    return following


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
