"""Multilayer perceptron with tanh units on the features of the state."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import quantity
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

    width: int = quantity(16, "units", "positive")
    depth: int = quantity(2, "layers", "positive")

    def layer_sizes(self, system: System) -> tuple[int, ...]:
        """Return the number of units of every layer, from the features to the outputs."""
        return (len(system.features), *[self.width] * self.depth, system.n_learned)

    def n_parameters(self, system: System) -> int:
        sizes = self.layer_sizes(system)
        return sum((n_in + 1) * n_out for n_in, n_out in itertools.pairwise(sizes))

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        """Draw every weight and bias of a layer uniformly in ±1/√(number of its inputs)."""
        sizes = self.layer_sizes(system)
        return np.concatenate(
            [
                rng.uniform(-1.0, 1.0, (n_in + 1) * n_out) / np.sqrt(n_in)
                for n_in, n_out in itertools.pairwise(sizes)
            ]
        )
