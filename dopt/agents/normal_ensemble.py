"""Ensemble of networks that predict normal distributions, and their disagreement.

======  ==========================================  ===========
symbol  meaning                                     shape
======  ==========================================  ===========
μ       means that the networks predict             E × N × r
v       variances                                   E × N × r
======  ==========================================  ===========
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from torch import Tensor, nn

from dopt.types import Array

SMALLEST_LOG, LARGEST_LOG = -10.0, 4.0
"""Range of the logarithms of variances, in units of the variance of the targets."""


class NormalEnsemble:
    """Networks with two hidden layers that learn by likelihood, each on minibatches of its own.

    Targets are scaled by their mean and spread at each fit.

    Parameters
    ----------
    shape : (int, int, int, int)
        Networks E, inputs, units of a layer, outputs r.
    learning_rate : float
    rng : numpy.random.Generator
        Draws initial weights and minibatches.
    """

    def __init__(
        self, shape: tuple[int, int, int, int], learning_rate: float, rng: np.random.Generator
    ) -> None:
        self._count, inputs, units, outputs = shape
        self._rng = rng
        sizes = (inputs, units, units, 2 * outputs)
        self._layers = [
            (self._drawn(before, after), torch.zeros(self._count, 1, after, requires_grad=True))
            for before, after in itertools.pairwise(sizes)
        ]
        parameters = [part for layer in self._layers for part in layer]
        self._optimizer = torch.optim.Adam(parameters, lr=learning_rate)
        self._center, self._scale = np.zeros(outputs), np.ones(outputs)

    def _drawn(self, before: int, after: int) -> Tensor:
        values = self._rng.standard_normal((self._count, before, after)) / math.sqrt(before)
        return torch.tensor(values, dtype=torch.float32, requires_grad=True)

    @torch.enable_grad()
    def fit(self, inputs: Array, targets: Array, updates: int, batch: int) -> None:
        """Take gradient steps on inputs (n, ·) and targets (n, r)."""
        spread = targets.std(axis=0)
        self._center, self._scale = targets.mean(axis=0), np.where(spread > 0, spread, 1.0)
        x = torch.tensor(inputs, dtype=torch.float32)
        y = torch.tensor((targets - self._center) / self._scale, dtype=torch.float32)
        for _ in range(updates):
            drawn = torch.from_numpy(self._rng.integers(len(x), size=(self._count, batch)))
            mean, log_variance = self._normal(x[drawn])
            error = (y[drawn] - mean).square() * torch.exp(-log_variance)
            self._optimizer.zero_grad()
            (error + log_variance).mean(dim=(1, 2)).sum().backward()
            self._optimizer.step()

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Return μ and v, (E, N, r) each, in the units of the targets, at inputs (N, ·)."""
        with torch.no_grad():
            x = torch.tensor(inputs, dtype=torch.float32).expand(self._count, -1, -1)
            mean, log_variance = (part.double().numpy() for part in self._normal(x))
        return self._center + self._scale * mean, self._scale**2 * np.exp(log_variance)

    def _normal(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return means and logarithms of variances of scaled targets, at (E, N, ·)."""
        *hidden, (weights, biases) = self._layers
        for hidden_weights, hidden_biases in hidden:
            x = nn.functional.silu(torch.baddbmm(hidden_biases, x, hidden_weights))
        mean, raw = torch.baddbmm(biases, x, weights).chunk(2, dim=2)
        share = torch.sigmoid(raw)
        return mean, SMALLEST_LOG + (LARGEST_LOG - SMALLEST_LOG) * share


def jensen_renyi_divergence(mean: Array, variance: Array) -> Array:
    """Return the divergence of normal distributions of equal weight, (N,), from μ and v.

    It is the quadratic Rényi entropy of their mixture less the mean of theirs: 0 where all are the
    same, and log E where none overlap, if all have the same variances.
    """
    E = len(mean)
    between = variance[:, None] + variance[None]
    apart = (mean[:, None] - mean[None]) ** 2 / between
    logs = -0.5 * np.sum(apart + np.log(2.0 * math.pi * between), axis=3)
    largest = logs.max(axis=(0, 1))
    mixture = 2.0 * math.log(E) - largest - np.log(np.exp(logs - largest).sum(axis=(0, 1)))
    own = 0.5 * np.sum(np.log(4.0 * math.pi * variance), axis=2).mean(axis=0)
    divergence: Array = mixture - own
    return divergence
