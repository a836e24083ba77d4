"""Multilayer perceptron with tanh units on the features of the state."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.declare.validated_fields import parameter
from dopt.models.base import Array, Model
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class MLP(Model):
    """Network of ``depth`` hidden layers of ``width`` tanh units and a linear output layer.

    The flat parameter vector is W₁, b₁, W₂, b₂, ... with each W row by row (outputs × inputs), the
    order of ``torch.nn.utils.parameters_to_vector`` for a stack of ``torch.nn.Linear``.

    Parameters
    ----------
    width : int
        Units in each hidden layer (16 in the paper).
    depth : int
        Number of hidden layers (2 in the paper).
    """

    name: ClassVar[str] = "mlp"
    compiled: ClassVar[bool] = True

    width: int = parameter(16, "units", "positive")
    depth: int = parameter(2, "layers", "positive")

    def layer_sizes(self, system: System) -> tuple[int, ...]:
        """Return the number of units of every layer, from the features to the outputs."""
        return (len(system.features), *[self.width] * self.depth, system.n_learned)

    def n_parameters(self, system: System) -> int:
        n_in, n_out, width = len(system.features), system.n_learned, self.width
        return (n_in + 1) * width + (self.depth - 1) * (width + 1) * width + (width + 1) * n_out

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        """Draw every weight and bias of a layer uniformly in ±1/√(number of its inputs)."""
        sizes = self.layer_sizes(system)
        return np.concatenate(
            [
                rng.uniform(-1.0, 1.0, (n_in + 1) * n_out) / np.sqrt(n_in)
                for n_in, n_out in itertools.pairwise(sizes)
            ]
        )

    def predict(self, system: System, parameters: Array, states: Array) -> Array:
        values = system.featurize(states)
        sizes, first = self.layer_sizes(system), 0
        for layer, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
            weights = parameters[first : first + n_in * n_out].reshape(n_out, n_in)
            first += n_in * n_out
            values = values @ weights.T + parameters[first : first + n_out]
            first += n_out
            if layer < self.depth:
                values = np.tanh(values)
        return values
