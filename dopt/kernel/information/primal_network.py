"""The q × q information matrix of a network in compiled code."""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.information.primal import quadratic_forms, rank_update
from dopt.kernel.model import all_components, linearization_at, network_gradients, network_rows
from dopt.kernel.structs import Network, Plant, State
from dopt.types import Matrix, Vector


@compiled
def add_rows(plant: Plant, network: Network, state: State, x: Vector) -> None:
    """Add JᵀJ at a state (:data:`dopt.kernel.structs.AddRows`)."""
    value = np.zeros(plant.learned_rows.shape[0])
    phi, hidden, deltas = all_components(network, state.theta, x, value)
    rows = network_rows(network, phi, hidden, deltas, state.theta.shape[0])
    rank_update(state.covariance, rows, np.zeros(rows.shape[0]), np.empty(rows.shape))


@compiled
def planning_forms(
    plant: Plant, network: Network, state: State, bar: Vector, columns: Matrix, component: int
) -> Matrix:
    """Return xᵀM⁻¹y at a state (:data:`dopt.kernel.structs.PlanningForms`)."""
    m, value = columns.shape[0], np.empty(plant.learned_rows.shape[0])
    point = linearization_at(network, state.theta, bar, columns, component, value)
    G = network_gradients(network, point, component, state.theta.shape[0])
    return quadratic_forms(state.covariance, G[: 1 if m == 1 else 1 + m], G)
