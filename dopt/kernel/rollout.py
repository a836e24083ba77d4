"""Many paths at once under a model or the truth, in compiled code.

Legend beside :mod:`dopt.kernel.structs`: H steps, n paths.
"""

from __future__ import annotations

import numpy as np

from dopt.kernel import network as nn
from dopt.kernel.compiler import called_from_python
from dopt.kernel.held_plant import HeldPlant
from dopt.kernel.integration import add_stage, n_stages, next_true_state, write_rate
from dopt.kernel.model import write_point_features
from dopt.kernel.structs import Network
from dopt.types import Matrix, Stack, Vector


@called_from_python
def follow_equations(held: HeldPlant, parameters: Vector, inputs: Stack, states: Stack) -> None:
    """Write the states, (H + 1, n, d), that follow the first under inputs (H, n, m)."""
    plant = held.plant
    for t in range(inputs.shape[0]):
        for i in range(inputs.shape[1]):
            next_true_state(plant, parameters, states[t, i], inputs[t, i], states[t + 1, i])


@called_from_python
def follow_network(
    held: HeldPlant, network: Network, thetas: Matrix, inputs: Stack, states: Stack
) -> None:
    """Write the states, (H + 1, n, d), that follow the first under inputs (H, n, m).

    They follow the mean of the networks with parameters ``thetas``, (E, q).
    """
    plant = held.plant
    n, d, r = inputs.shape[1], states.shape[2], plant.learned_rows.shape[0]
    depth, width = network.offsets.shape[0] - 1, network.sizes[1]
    rate, value, total = np.empty(d), np.empty(r), np.empty((n, d))
    features, outputs = np.empty((network.feature_kinds.shape[0], n)), np.empty((r, n))
    one = np.empty((r, n))
    hidden = np.empty((depth, width * n))
    for t in range(inputs.shape[0]):
        states[t + 1] = states[t]
        for stage in range(n_stages(plant)):
            write_point_features(network, states[t + 1], inputs[t], features)
            nn.mean_forward(network, thetas, features, hidden, outputs, one)
            for i in range(n):
                x, following = states[t, i], states[t + 1, i]
                for k in range(r):
                    value[k] = outputs[k, i]
                write_rate(plant, following, inputs[t, i], value, rate)
                add_stage(plant, stage, plant.dt, x, rate, total[i], following)
