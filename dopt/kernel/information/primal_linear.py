"""The q × q information matrix of any model but a network in compiled code."""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.information.primal import quadratic_forms, rank_update
from dopt.kernel.model import parameter_gradients, parameter_rows
from dopt.kernel.state_structs import State
from dopt.kernel.structs import Network, Plant
from dopt.types import Matrix, Vector


@compiled
def add_rows(plant: Plant, network: Network, state: State, x: Vector) -> None:
    """Add JᵀJ at a state (:data:`dopt.kernel.structs.AddRows`)."""
    r = plant.learned_rows.shape[0]
    rows = np.empty((r, state.theta.shape[0]))
    parameter_rows(plant, network, state.theta, x, rows, np.empty(r))
    rank_update(state.covariance, rows, np.zeros(r), np.empty(rows.shape))


@compiled
def planning_forms(
    plant: Plant,
    network: Network,
    state: State,
    bar: Vector,
    columns: Matrix,
    component: int,
) -> Matrix:
    """Return xᵀM⁻¹y at a state (:data:`dopt.kernel.structs.PlanningForms`)."""
    m = columns.shape[0]
    G = parameter_gradients(plant, network, state.theta, bar, columns, component)
    return quadratic_forms(state.covariance, G[: 1 if m == 1 else 1 + m], G)
