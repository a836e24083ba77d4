"""Points of samples, and a ring of the newest, in compiled code."""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.network import features_at
from dopt.kernel.points import model_point, sampled_state
from dopt.kernel.structs import Network, Trial
from dopt.types import Matrix, Vector


@compiled
def sampled_point(trial: Trial, t: int) -> Vector:
    """Return where the accelerations of step t were observed: a state, or a state and u_t."""
    state = sampled_state(trial.plant, trial.record.states, t)
    return model_point(trial.network, state, trial.state.estimate.inputs[t])


@compiled
def store_sample(
    network: Network, features: Matrix, targets: Matrix, t: int, x: Vector, target: Vector
) -> None:
    """Put the features of a point and the accelerations observed there, (r,), into a ring."""
    slot = t % features.shape[1]
    phi = np.empty(network.feature_kinds.shape[0])
    features_at(network, x, phi)
    for i in range(phi.shape[0]):
        features[i, slot] = phi[i]
    for k in range(target.shape[0]):
        targets[k, slot] = target[k]
