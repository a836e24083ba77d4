"""Rows of J for every model, and the filter step of the learners that use them."""

from __future__ import annotations

import numpy as np

from dopt.algorithm import ModelKind
from dopt.kernel.compiler import compiled
from dopt.kernel.information.primal import rank_update
from dopt.kernel.model import network_jacobian, parameter_rows
from dopt.kernel.state_structs import Covariance
from dopt.kernel.structs import Network, Plant
from dopt.types import Matrix, Vector


@compiled
def model_rows(plant: Plant, network: Network, theta: Vector, x: Vector, value: Vector) -> Matrix:
    """Return J, (r, q), at a point, and write a_θ, (r,), there."""
    if network.kind != ModelKind.MLP:
        rows = np.empty((value.shape[0], theta.shape[0]))
        parameter_rows(plant, network, theta, x, rows, value)
        return rows
    return network_jacobian(network, theta, x, value)


@compiled
def filter_step(covariance: Covariance, theta: Vector, rows: Matrix, residuals: Vector) -> None:
    """Add JᵀJ to M for J, (r, q), and correct θ by the residuals, (r,), which are overwritten."""
    scratch = np.empty(rows.shape)
    rank_update(covariance, rows, residuals, scratch)
    for k in range(residuals.shape[0]):
        for i in range(theta.shape[0]):
            theta[i] += residuals[k] * scratch[k, i]
