"""A network of one's own: a linear law, and what a small network adds to it."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Residual(nn.Module):
    """a(φ) = A φ + b + W tanh(V φ + c), with ``width`` tanh units.

    Parameters
    ----------
    n_features, n_outputs : int
        Numbers p of features and r of learned accelerations, which the system gives.
    width : int
        Units of the network.
    """

    def __init__(self, n_features: int, n_outputs: int, width: int = 16) -> None:
        super().__init__()
        self.law = nn.Linear(n_features, n_outputs)
        self.hidden = nn.Linear(n_features, width)
        self.rest = nn.Linear(width, n_outputs)

    def forward(self, features: Tensor) -> Tensor:
        """Return the accelerations, (r,), of features, (p,)."""
        out: Tensor = self.law(features) + self.rest(torch.tanh(self.hidden(features)))
        return out
