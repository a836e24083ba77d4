"""Users' networks, some of them mistakes, and models of the reference for one point."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import torch
from torch import Tensor, nn

from dopt.models import Model
from dopt.reference.models import model_function
from dopt.systems.base import System


class Stack(nn.Module):
    """The shipped multilayer perceptron, in float32 as torch builds it."""

    def __init__(self, n_features: int, n_outputs: int, width: int = 16, depth: int = 2) -> None:
        super().__init__()
        sizes = (n_features, *[width] * depth, n_outputs)
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))

    def forward(self, features: Tensor) -> Tensor:
        for layer in self.layers[:-1]:
            features = torch.tanh(layer(features))
        out: Tensor = self.layers[-1](features)
        return out


class Wide(Stack):
    """Returns one output too many."""

    def __init__(self, n_features: int, n_outputs: int) -> None:
        super().__init__(n_features, n_outputs + 1)


class Empty(nn.Module):
    """Has nothing to learn."""

    def __init__(self, n_features: int, n_outputs: int) -> None:  # noqa: ARG002
        super().__init__()
        self.n_outputs = n_outputs

    def forward(self, features: Tensor) -> Tensor:
        return features.sum() * torch.ones(self.n_outputs)


class Broken(Stack):
    def forward(self, features: Tensor) -> Tensor:
        raise RuntimeError(f"no way from {features.shape[-1]} features")


def model_of_one(system: System, model: Model) -> Callable[[Tensor, Tensor], Tensor]:
    """Return a_θ of a model: parameters (q,), a point, (d,) or (d + m,), to accelerations (r,)."""
    function = model_function(system, model)
    return lambda theta, x: function(theta[None], x[None, None])[0, 0]
