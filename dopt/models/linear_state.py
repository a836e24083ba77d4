"""Linear map of the features: for systems that are linear in the state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.models.base import Array, Model
from dopt.systems.base import System


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
        predicted: Array = system.featurize(points) @ matrix.T
        return predicted
