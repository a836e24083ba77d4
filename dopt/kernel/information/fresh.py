"""Information of all states visited at the present parameters of a network, in compiled code."""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.information.cholesky import factorize, write_inverse
from dopt.kernel.information.normal_equations import normal_matrix
from dopt.kernel.information.primal_network import add_rows as add_newest_rows
from dopt.kernel.information.primal_network import planning_forms
from dopt.kernel.network import features_at
from dopt.kernel.state_structs import State
from dopt.kernel.structs import Network, Plant
from dopt.types import Vector

__all__ = ["add_rows", "planning_forms"]


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
        add_newest_rows(plant, network, state, x)
        return
    normal, r = np.empty((q, q)), plant.learned_rows.shape[0]
    normal_matrix(network, state.theta, visited.features[:, : n + 1].copy(), r, normal)
    for i in range(q):
        normal[i, i] += visited.regularization
    if not (factorize(normal) and write_inverse(normal, covariance.upper)):
        state.theta[:] = np.nan
    covariance.n_pending[0] = 0
