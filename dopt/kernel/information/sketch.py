"""Projection of parameter gradients to a few dimensions (count sketch) in compiled code.

Every parameter adds to one of s entries with a random sign, so that inner products are kept on
average; M⁻¹ is then s × s whatever the width and the horizon. Reference: M. Charikar, K. Chen and
M. Farach-Colton, "Finding frequent items in data streams" (2002).
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.information.primal import quadratic_forms, rank_update
from dopt.kernel.model import gradients_along_inputs, network_jacobian
from dopt.kernel.state_structs import Sketch, State
from dopt.kernel.structs import Network, Plant
from dopt.types import Matrix, Vector


@compiled
def sketched(sketch: Sketch, rows: Matrix) -> Matrix:
    """Return the sketch, (k, s), of gradients, (k, q)."""
    out = np.zeros((rows.shape[0], sketch.size))
    for k in range(rows.shape[0]):
        for i in range(rows.shape[1]):
            out[k, sketch.buckets[i]] += sketch.signs[i] * rows[k, i]
    return out


@compiled
def add_rows(plant: Plant, network: Network, state: State, x: Vector) -> None:
    """Add JᵀJ at a state (:data:`dopt.kernel.structs.AddRows`)."""
    value = np.zeros(plant.learned_rows.shape[0])
    rows = sketched(state.sketch, network_jacobian(network, state.theta, x, value))
    rank_update(state.covariance, rows, value, np.empty(rows.shape))  # no residuals: θ stays


@compiled
def planning_forms(
    plant: Plant, network: Network, state: State, bar: Vector, columns: Matrix, component: int
) -> Matrix:
    """Return xᵀM⁻¹y at a state (:data:`dopt.kernel.structs.PlanningForms`)."""
    m = columns.shape[0]
    gradients = gradients_along_inputs(plant, network, state.theta, bar, columns, component)
    G = sketched(state.sketch, gradients)
    return quadratic_forms(state.covariance, G[: 1 if m == 1 else 1 + m], G)
