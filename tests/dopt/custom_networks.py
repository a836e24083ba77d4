"""Networks of a user's own: one that is the shipped model, and some that are mistakes."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn


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
