"""Gaussian processes, with a fixed kernel or one that their evidence chooses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.models.base import Model
from dopt.systems.base import System
from dopt.types import Array

ROUNDING = 1e-10
"""Least variance of the noise, by the prior variance: the factorisation needs some."""

MOST_SAMPLES = 2000
"""Samples for which there is room; where there are more, they are merged."""


@dataclass(frozen=True, kw_only=True)
class GaussianProcess(Model):
    """One process for each learned acceleration, with a mean of zero.

    The model is the posterior mean a(x) = Σ_i k(x, x_i) α_i with α = (K + ν I)⁻¹ y. With
    ``hyperparameters`` "fixed" all rows have the kernel k(x, x') = s² exp(-‖φ - φ'‖²/2ℓ²) of the
    features φ. With "evidence" row k has

        k(x, x') = s² exp(-½ Σ_j w_j (φ_j - φ'_j)²) + Σ_j l_j φ_j φ'_j + c

    with numbers of its own, which maximise the probability of the samples (the marginal likelihood)
    beside a weak prior (:mod:`dopt.kernel.evidence`). References: C. Rasmussen and C. Williams,
    "Gaussian processes for machine learning", chapters 2 and 5 (2006); for exploration, the
    paper's [8].

    The flat parameter vector holds the features of the samples, (p, C), with room for C of them,
    and α, (r, C); places of samples not yet taken are zero and add nothing. With "evidence" the
    numbers w, s², l, c and ν of each row, (r, 2p + 3), follow.

    Parameters
    ----------
    lengthscale : float
        ℓ, in units of the features, which are of order one on the grid; before the first fit of the
        evidence as well.
    amplitude : float
        s, prior standard deviation of the accelerations; likewise.
    hyperparameters : {"fixed", "evidence"}
        Whether the kernel stays.
    noise : {"known", "fitted"}
        Whether ν is the trial's variance of an observed acceleration, σ²/dt, or one more number
        that the evidence chooses, as it does where σ is 0, such as for a plant.
    """

    name: ClassVar[str] = "gaussian_process"
    structure: ClassVar[str] = "conditioning"
    compiled: ClassVar[bool] = True

    lengthscale: float = parameter(1.0, bound="positive")
    amplitude: float = parameter(10.0, bound="positive")
    hyperparameters: str = parameter("fixed", choices=("fixed", "evidence"), added=True)
    noise: str = parameter("known", choices=("known", "fitted"), added=True)

    @property
    def is_tuned(self) -> bool:
        """Whether the evidence chooses the numbers of the kernels."""
        return self.hyperparameters == "evidence"

    def room(self, system: System) -> int:
        """Return C."""
        return min(system.horizon, MOST_SAMPLES)

    def n_parameters(self, system: System) -> int:
        p, r = len(system.features), system.n_learned
        return self.room(system) * (p + r) + (r * (2 * p + 3) if self.is_tuned else 0)

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:  # noqa: ARG002  # nothing is random here
        parameters = np.zeros(self.n_parameters(system))
        if self.is_tuned:
            r = system.n_learned
            size = parameters[-r * (2 * len(system.features) + 3) :].reshape(r, -1)
            size[:] = self.fixed_numbers(system)
        return parameters

    def fixed_numbers(self, system: System) -> Array:
        """Return the numbers of the fixed kernel, (2p + 3,)."""
        p = len(system.features)
        w, nothing = [self.lengthscale**-2] * p, [0.0] * (p + 1)
        return np.array([*w, self.amplitude**2, *nothing, self.noise_variance(system)])

    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        C, p, r = self.room(system), len(system.features), system.n_learned
        centers, alpha = parameters[: p * C].reshape(p, C), parameters[p * C : (p + r) * C]
        if self.is_tuned:
            numbers = parameters[(p + r) * C :].reshape(r, -1)
        else:
            numbers = np.broadcast_to(self.fixed_numbers(system), (r, 2 * p + 3))
        phi = system.featurize(points)
        rows = zip(numbers, alpha.reshape(r, C), strict=True)
        return np.stack([kernel(n, phi, centers.T) @ weights for n, weights in rows], axis=-1)

    def known_noise(self, system: System) -> float | None:
        """Return ν, None where the evidence chooses it."""
        known = self.noise == "known" and system.noise > 0.0
        return self.noise_variance(system) if known else None

    def noise_variance(self, system: System) -> float:
        """Return σ²/dt, or what rounding needs if that is more."""
        return max(system.noise**2 / system.dt, ROUNDING * self.amplitude**2)


def kernel(numbers: Array, phi: Array, other: Array) -> Array:
    """Return k, (N, N'), between features (N, p) and (N', p), for numbers (2p + 3,)."""
    p = phi.shape[1]
    squares = (numbers[:p] * np.square(phi[:, None] - other[None])).sum(axis=-1)
    linear = (phi * numbers[p + 1 : 2 * p + 1]) @ other.T
    values: Array = numbers[p] * np.exp(-0.5 * squares) + linear + numbers[2 * p + 1]
    return values
