"""Predicted next state and the effect of the inputs on it, in compiled code."""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.model import euler_step, model_accelerations
from dopt.kernel.structs import Network, Plant
from dopt.types import Matrix, Vector


@compiled
def predicted_state(plant: Plant, network: Network, theta: Vector, x: Vector) -> Vector:
    """Return x̄ = x + dt f_θ(x, 0), (d,)."""
    flow, following = np.empty(x.shape[0]), np.empty(x.shape[0])
    a = np.empty(plant.learned_rows.shape[0])
    model_accelerations(plant, network, theta, x, a)
    euler_step(plant, x, np.zeros(plant.n_inputs), a, flow, following)
    return following


@compiled
def input_columns(plant: Plant, x: Vector) -> Matrix:
    """Return the rows of Bᵀ = dt (∂f/∂u)ᵀ, (m, d), at a state; the input term is linear."""
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
