"""Deterministic actor of an agent, as it was when it was asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dopt.types import Array


@dataclass(frozen=True, eq=False)
class Actor:
    """A network with rectified layers and tanh at its end.

    Attributes
    ----------
    layers : tuple of ((outputs, inputs), (outputs,))
        Weights and biases, from the first layer to the last.
    """

    layers: tuple[tuple[Array, Array], ...]

    def __call__(self, observed: Array) -> Array:
        """Return the actions, (..., m), within ±1, for observations (..., n_observed)."""
        *hidden, last = self.layers
        for weights, biases in hidden:
            observed = np.maximum(observed @ weights.T + biases, 0.0)
        weights, biases = last
        action: Array = np.tanh(observed @ weights.T + biases)
        return action
