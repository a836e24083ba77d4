"""L2 error of the model over the evaluation points in compiled code."""

from __future__ import annotations

from typing import Any

import numpy as np

from dopt.kernel.arguments import LINEAR_MODEL, Evaluation, Network
from dopt.kernel.compiler import compiled
from dopt.kernel.network import forward

BLOCK = 256
"""Points evaluated at a time: the activations of a block stay in the first-level cache."""


@compiled
def model_error(
    network: Network, theta: Any, points: Evaluation, start: int, stop: int, buffers: Any
) -> float:
    """Return sqrt(mean ‖a_θ(x) - a(x)‖²) over the points from ``start`` to ``stop``."""
    if stop <= start:
        return np.nan
    hidden, outputs = buffers
    total = 0.0
    if network.kind == LINEAR_MODEL:
        for i in range(start, stop):
            for k in range(points.targets.shape[1]):
                value = -points.targets[i, k]
                for j in range(theta.shape[0]):
                    value += points.regressors[i, k, j] * theta[j]
                total += value * value
        return float(np.sqrt(total / (stop - start)))
    for first in range(start, stop, BLOCK):
        last = min(first + BLOCK, stop)
        values = outputs[: last - first]
        forward(network, theta, points.features[first:last], hidden, values)
        for i in range(last - first):
            for k in range(values.shape[1]):
                total += (values[i, k] - points.targets[first + i, k]) ** 2
    return float(np.sqrt(total / (stop - start)))
