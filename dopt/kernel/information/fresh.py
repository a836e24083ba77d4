"""Information of all states visited at the present parameters, in compiled code."""

from __future__ import annotations

import numpy as np

from dopt.algorithm import ModelKind
from dopt.kernel import grey_box
from dopt.kernel.compiler import compiled
from dopt.kernel.information import primal_linear, primal_network
from dopt.kernel.information.cholesky import factorize, write_inverse
from dopt.kernel.information.normal_equations import normal_matrix
from dopt.kernel.network import features_at
from dopt.kernel.state_structs import State
from dopt.kernel.structs import Network, Plant
from dopt.types import Matrix, Vector


@compiled
def add_rows(plant: Plant, network: Network, state: State, x: Vector) -> None:
    """Add JᵀJ at a state; in every k-th step sum M of all states (:data:`structs.AddRows`).

    θ is NaN afterwards, which ends the trial as diverged, where rounding has left M indefinite or
    its inverse is not finite.
    """
    visited, covariance = state.visited, state.covariance
    n, q = visited.n_states[0], state.theta.shape[0]
    phi = np.empty(network.feature_kinds.shape[0])
    features_at(network, x, phi)
    for i in range(phi.shape[0]):
        visited.features[i, n] = phi[i]
    visited.n_states[0] = n + 1
    if (n + 1) % visited.refresh_every != 0:
        if network.kind == ModelKind.MLP:
            primal_network.add_rows(plant, network, state, x)
        else:
            primal_linear.add_rows(plant, network, state, x)
        return
    normal, r = np.empty((q, q)), plant.learned_rows.shape[0]
    seen = visited.features[:, : n + 1].copy()
    if network.kind == ModelKind.MLP:
        normal_matrix(network, state.theta, seen, r, normal)
    else:
        nothing, slope = np.zeros((r, n + 1)), np.empty(q)
        grey_box.write_normal_equations(plant, network, state.theta, seen, nothing, normal, slope)
    for i in range(q):
        normal[i, i] += visited.regularization
    if not (factorize(normal) and write_inverse(normal, covariance.upper)):
        state.theta[:] = np.nan
    covariance.n_pending[0] = 0


@compiled
def planning_forms(
    plant: Plant, network: Network, state: State, bar: Vector, columns: Matrix, component: int
) -> Matrix:
    """Return xᵀM⁻¹y at a state (:data:`dopt.kernel.structs.PlanningForms`)."""
    if network.kind == ModelKind.MLP:
        return primal_network.planning_forms(plant, network, state, bar, columns, component)
    return primal_linear.planning_forms(plant, network, state, bar, columns, component)
