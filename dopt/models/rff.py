"""Random Fourier features: a kernel method of fixed size that is linear in its parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.declare.validated_fields import parameter
from dopt.models.base import Array, Model
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class RFF(Model):
    """a_θ(x) = W ψ(x), ψ(x) = s √(2/D) cos(Ω φ(x) + b), with φ the system's features.

    The rows of Ω are drawn from N(0, I/ℓ²) and the phases b uniformly from a circle, by the seed of
    the trial; they stay. Then E ψ(x)·ψ(x') = s² exp(-‖φ - φ'‖²/2ℓ²): least squares for W with the
    ridge λ is Bayesian linear regression, which tends to the Gaussian process of that kernel, noise
    variance λ, as D grows. W starts at zero. References: A. Rahimi and B. Recht, "Random features
    for large-scale kernel machines" (NIPS 2007); for exploration, the paper's [9].

    The flat parameter vector is W, Ω, b, each row by row. Only W is learned.

    Parameters
    ----------
    n_features : int
        D.
    lengthscale : float
        ℓ, in units of the features, which are of order one on the grid.
    amplitude : float
        s, prior standard deviation of the accelerations where λ is the variance of the noise.
    """

    name: ClassVar[str] = "rff"
    structure: ClassVar[str] = "least_squares"
    compiled: ClassVar[bool] = True

    n_features: int = parameter(100, "features", "positive")
    lengthscale: float = parameter(1.0, bound="positive")
    amplitude: float = parameter(10.0, bound="positive")

    def n_parameters(self, system: System) -> int:
        return self.n_features * system.n_learned + self.n_fixed_parameters(system)

    def n_fixed_parameters(self, system: System) -> int:
        return self.n_features * (len(system.features) + 1)

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        weights = np.zeros(self.n_features * system.n_learned)
        frequencies = rng.standard_normal(self.n_features * len(system.features))
        phases = rng.uniform(0.0, 2.0 * math.pi, self.n_features)
        return np.concatenate([weights, frequencies / self.lengthscale, phases])

    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        first = self.n_features * system.n_learned
        last = len(parameters) - self.n_features
        weights = parameters[:first].reshape(system.n_learned, self.n_features)
        frequencies = parameters[first:last].reshape(self.n_features, len(system.features))
        waves = np.cos(system.featurize(points) @ frequencies.T + parameters[last:])
        predicted: Array = self.scale * waves @ weights.T
        return predicted

    @property
    def scale(self) -> float:
        """S √(2/D)."""
        return self.amplitude * math.sqrt(2.0 / self.n_features)
