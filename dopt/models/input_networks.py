"""Networks that also learn what the inputs do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.models.base import Array
from dopt.models.mlp import MLP
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class BlackBoxMLP(MLP):
    """a_θ(x, u): a network (:class:`dopt.models.MLP`) of the features of x and of u/γ.

    Nothing is assumed of the effect of the inputs.
    """

    name: ClassVar[str] = "black_box"
    compiled: ClassVar[bool] = True
    affine_in_inputs: ClassVar[bool] = False

    def n_inputs_read(self, system: System) -> int:
        return system.n_inputs


@dataclass(frozen=True, kw_only=True)
class AffineMLP(BlackBoxMLP):
    """a_θ(x) + B_θ(x) u, with a_θ and the columns of B_θ the outputs of one network of x.

    With h the last hidden layer, the output layer is linear in (h, h u₁/γ, ..., h u_m/γ, u/γ): one
    matrix W, (r, (1 + m) w + m), and a bias, (r,). In the flat parameter vector they come last, as
    those of the last layer of :class:`dopt.models.MLP`.
    """

    name: ClassVar[str] = "affine"
    compiled: ClassVar[bool] = True
    affine_in_inputs: ClassVar[bool] = True

    def n_first_inputs(self, system: System) -> int:
        return len(system.features)

    def n_output_inputs(self, system: System) -> int:
        return (1 + system.n_inputs) * self.width + system.n_inputs

    def output_inputs(self, system: System, hidden: Array, features: Array) -> Array:
        m = system.n_inputs
        u = features[:, -m:]
        products = [hidden * u[:, j : j + 1] for j in range(m)]
        inputs: Array = np.concatenate([hidden, *products, u], axis=1)
        return inputs
