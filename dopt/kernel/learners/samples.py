"""Ring of the newest samples in compiled code."""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.network import features_at
from dopt.kernel.structs import Network
from dopt.types import Matrix, Vector


@compiled
def store_sample(
    network: Network, features: Matrix, targets: Matrix, t: int, x: Vector, target: Vector
) -> None:
    """Put the features of x_t, (d,), and the observed accelerations, (r,), into a ring."""
    slot = t % features.shape[1]
    phi = np.empty(network.sizes[0])
    features_at(network, x, phi)
    for i in range(phi.shape[0]):
        features[i, slot] = phi[i]
    for k in range(target.shape[0]):
        targets[k, slot] = target[k]
