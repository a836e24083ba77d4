"""Exact Gaussian process of the learned accelerations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from dopt.declare.validated_fields import parameter
from dopt.models.base import Array, Model
from dopt.systems.base import System

ROUNDING = 1e-10
"""Least variance of the noise, by the prior variance: the factorisation needs some."""


@dataclass(frozen=True, kw_only=True)
class GaussianProcess(Model):
    """Independent processes with one kernel, k(x, x') = s² exp(-‖φ(x) - φ(x')‖²/2ℓ²), mean zero.

    The noise is the trial's: an observed acceleration has the variance σ²/dt. The model is the
    posterior mean a(x) = Σ_i k(x, x_i) α_i with α = (K + σ²/dt I)⁻¹ Y. References: C. Rasmussen and
    C. Williams, "Gaussian processes for machine learning", chapter 2 (2006); for exploration, the
    paper's [8].

    The flat parameter vector holds what the mean is made of: the features of the T states at which
    samples are taken, (T, p), then α, (T, r), both row by row. Rows of samples not yet taken are
    zero and add nothing.

    Parameters
    ----------
    lengthscale : float
        ℓ, in units of the features, which are of order one on the grid.
    amplitude : float
        s, prior standard deviation of the accelerations.
    """

    name: ClassVar[str] = "gaussian_process"
    structure: ClassVar[str] = "conditioning"
    compiled: ClassVar[bool] = True

    lengthscale: float = parameter(1.0, bound="positive")
    amplitude: float = parameter(10.0, bound="positive")

    def n_parameters(self, system: System) -> int:
        return system.horizon * (len(system.features) + system.n_learned)

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:  # noqa: ARG002  # nothing is random here
        return np.zeros(self.n_parameters(system))

    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        first = system.horizon * len(system.features)
        centers = parameters[:first].reshape(system.horizon, -1)
        alpha = parameters[first:].reshape(system.horizon, -1)
        predicted: Array = self.kernel(system.featurize(points), centers) @ alpha
        return predicted

    def kernel(self, phi: Array, other: Array) -> Array:
        """Return k, (N, N'), between features (N, p) and (N', p)."""
        squares = np.square(phi[:, None] - other[None]).sum(axis=-1)
        values: npt.NDArray[np.float64] = np.exp(-0.5 * squares / self.lengthscale**2)
        return self.amplitude**2 * values

    def noise_variance(self, system: System) -> float:
        """Return σ²/dt, or what rounding needs if that is more."""
        return max(system.noise**2 / system.dt, ROUNDING * self.amplitude**2)
