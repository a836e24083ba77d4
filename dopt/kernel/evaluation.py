"""L2 error of the model over the evaluation points in compiled code."""

from __future__ import annotations

from typing import Any

import numpy as np

from dopt.kernel.arguments import LINEAR_MODEL, Evaluation, Network
from dopt.kernel.compiler import compiled, vectorized
from dopt.kernel.network import forward

BLOCK = 256
"""Points evaluated at a time: the activations of a block stay in the first-level cache."""


@compiled
def model_error(
    network: Network, theta: Any, points: Evaluation, start: int, stop: int, buffers: Any
) -> float:
    """Return sqrt(mean ‖a_θ(x) - a(x)‖²) over the points from ``start`` to ``stop``.

    The network's points come in blocks, and both bounds lie between blocks or at the end.
    """
    total, count = 0.0, 0
    if network.kind == LINEAR_MODEL:
        for i in range(start, stop):
            for k in range(points.targets.shape[1]):
                value = -points.targets[i, k]
                for j in range(theta.shape[0]):
                    value += points.regressors[i, k, j] * theta[j]
                total += value * value
        count = stop - start
    else:
        hidden, outputs = buffers
        for block in range(start, stop):
            forward(network, theta, points.features[block], hidden, outputs)
            used = points.block_sizes[block]
            total += _squared_errors(outputs, points.block_targets[block], used)
            count += used
    return float(np.sqrt(total / count)) if count else np.nan


@vectorized
def _squared_errors(outputs: Any, targets: Any, n: int) -> float:
    """Return Σ (output - target)² over the first n columns."""
    total = 0.0
    for k in range(outputs.shape[0]):
        values, truth = outputs[k], targets[k]
        for i in range(n):
            error = values[i] - truth[i]
            total += error * error
    return total
