"""Update of the information matrix by a sample, and the correction of θ that goes with it."""

from __future__ import annotations

import numpy as np

from dopt.algorithm import Form, ModelKind
from dopt.kernel.compiler import compiled
from dopt.kernel.information.dual import dual_rank_update
from dopt.kernel.information.primal import rank_update
from dopt.kernel.information.sketch import sketched
from dopt.kernel.model import add_linear, all_components, network_rows, regressors
from dopt.kernel.structs import Algorithm, Covariance, Network, Plant, State
from dopt.types import Matrix, Vector


@compiled
def model_rows(plant: Plant, network: Network, theta: Vector, x: Vector, value: Vector) -> Matrix:
    """Return J, (r, q), at a state, and write a_θ(x), (r,)."""
    if network.kind == ModelKind.LINEAR:
        rows = np.empty((value.shape[0], theta.shape[0]))
        regressors(plant, x, rows, value)
        add_linear(rows, theta, value)
        return rows
    phi, hidden, deltas = all_components(network, theta, x, value)
    return network_rows(network, phi, hidden, deltas, theta.shape[0])


@compiled
def update_information(
    plant: Plant, network: Network, algorithm: Algorithm, state: State, x: Vector
) -> None:
    """Add JᵀJ at a state and the current parameters to M, in the form that holds it."""
    residuals = np.zeros(plant.learned_rows.shape[0])
    if network.kind != ModelKind.LINEAR and algorithm.form == Form.DUAL:
        phi, hidden, deltas = all_components(network, state.theta, x, residuals)
        dual_rank_update(state.dual, algorithm.regularization, phi, hidden, deltas)
        return
    rows = model_rows(plant, network, state.theta, x, residuals)
    if network.kind != ModelKind.LINEAR and algorithm.form == Form.SKETCH:
        rows = sketched(state.sketch, rows)
    rank_update(state.covariance, rows, residuals, np.empty(rows.shape))


@compiled
def filter_step(covariance: Covariance, theta: Vector, rows: Matrix, residuals: Vector) -> None:
    """Add JᵀJ to M for J, (r, q), and correct θ by the residuals, (r,), which are overwritten."""
    scratch = np.empty(rows.shape)
    rank_update(covariance, rows, residuals, scratch)
    for k in range(residuals.shape[0]):
        for i in range(theta.shape[0]):
            theta[i] += residuals[k] * scratch[k, i]
