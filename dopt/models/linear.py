"""Linear form in known regressors: what an oracle knows of the physics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.models.base import Array, Model
from dopt.systems.base import System


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
        offset, *units = (
            np.stack(np.broadcast_arrays(*system.accelerations(tuple(points.T), form)), axis=-1)
            for form in system.linear_form
        )
        regressors = np.stack([unit - offset for unit in units], axis=-1)
        predicted: Array = offset + regressors @ parameters
        return predicted
