"""Models linear in their parameters, and grey boxes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.models.base import Model
from dopt.systems.base import Feature, System
from dopt.types import Array


@dataclass(frozen=True, kw_only=True)
class Linear(Model):
    """a(x) = offset(x) + Ψ(x) θ, with θ the system's ``linear_parameters`` (section 3, oracle).

    The regressors Ψ are the system's own equations, evaluated at unit parameters
    (:attr:`dopt.systems.base.System.linear_form`). Learning starts from θ = 0.
    """

    name: ClassVar[str] = "linear"
    structure: ClassVar[str] = "least_squares"
    compiled: ClassVar[bool] = True

    def n_parameters(self, system: System) -> int:
        return len(system.linear_parameters)

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:  # noqa: ARG002  # nothing is random here
        return np.zeros(self.n_parameters(system))

    def n_inputs_read(self, system: System) -> int:
        return system.n_inputs if system.reads_inputs else 0

    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        offset, regressors = linear_terms(system, points)
        return offset + regressors @ parameters


def linear_terms(system: System, points: Array) -> tuple[Array, Array]:
    """Return offset, (N, r), and Ψ, (N, r, q), of the linear form at points (N, d or d + m)."""
    offset, *units = (
        np.stack(np.broadcast_arrays(*system.accelerations(tuple(points.T), form)), axis=-1)
        for form in system.linear_form
    )
    return offset, np.stack([unit - offset for unit in units], axis=-1)


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
        return self.scale * waves @ weights.T

    @property
    def scale(self) -> float:
        """S √(2/D)."""
        return self.amplitude * math.sqrt(2.0 / self.n_features)


@dataclass(frozen=True, kw_only=True)
class LinearState(Model):
    """a_θ(x) = Θ φ(x), with φ the system's features and every entry of Θ, (r, p), unknown.

    Where the features are the state itself this is the model of linear identification, the paper's
    [7]. Learning starts from Θ = 0; the flat parameter vector is Θ row by row.
    """

    name: ClassVar[str] = "linear_state"
    structure: ClassVar[str] = "least_squares"
    compiled: ClassVar[bool] = True

    def n_parameters(self, system: System) -> int:
        return system.n_learned * len(system.features)

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:  # noqa: ARG002  # nothing is random here
        return np.zeros(self.n_parameters(system))

    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        matrix = parameters.reshape(system.n_learned, len(system.features))
        return system.featurize(points) @ matrix.T


@dataclass(frozen=True, kw_only=True)
class GreyBox(Model):
    """a_θ(x) is the system's a(x) with θ in the place of its unknown physical parameters.

    The equations may depend on θ in any way; where they are affine in it, :class:`Linear` is the
    same model, solved for. A system that changes with time is modelled as one that does not, with
    its known parameters as at the start: a learner that forgets can follow the unknown ones.

    Parameters
    ----------
    unknown : tuple of str
        Names of unknown parameters, out of the system's ``physical``; empty: its
        ``linear_parameters``.
    initial : tuple of float
        First guess of each, in its unit; empty: 1 of each.
    spread : float
        Standard deviation of a trial's initial parameters about the first guess, in their units.
    """

    name: ClassVar[str] = "grey_box"
    compiled: ClassVar[bool] = True

    unknown: tuple[str, ...] = parameter(())
    initial: tuple[float, ...] = parameter(())
    spread: float = parameter(0.1, bound="nonnegative")

    def names(self, system: System) -> tuple[str, ...]:
        """Return the names of the q parameters that are learned."""
        return self.unknown or system.linear_parameters

    def n_parameters(self, system: System) -> int:
        return len(self.names(system))

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        guess = np.array(self.initial or [1.0] * self.n_parameters(system))
        return guess + self.spread * rng.standard_normal(len(guess))

    def n_inputs_read(self, system: System) -> int:
        return system.n_inputs if system.reads_inputs else 0

    def features(self, system: System) -> tuple[Feature, ...]:
        """Return the point itself: the equations read states, and the inputs where they count."""
        read = system.n_states + self.n_inputs_read(system)
        return tuple(Feature("identity", index) for index in range(read))

    def feature_scales(self, system: System) -> tuple[float, ...]:
        return (1.0,) * len(self.features(system))

    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        values = dict(zip(system.physical, system.parameters, strict=True))
        values |= dict(zip(self.names(system), parameters.tolist(), strict=True))
        rows = system.accelerations(tuple(points.T), list(values.values()))
        return np.stack(np.broadcast_arrays(*rows, points[:, 0])[:-1], axis=-1)
