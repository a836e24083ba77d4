"""Base class of model specifications."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from dopt.fields import KernelSupport
from dopt.systems.base import Feature, System, feature_values, with_inputs

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Model(KernelSupport):
    """A parametric model of the r learned accelerations of a system.

    ``structure`` says how its parameters can be learned: by gradient, by least squares because the
    model is linear in them, by conditioning on all samples, or by fits of one network of an
    ensemble after the other. A learner names the one it teaches. ``affine_in_inputs`` says whether
    the accelerations are affine in the inputs for any parameters; a model that does not read inputs
    is.
    """

    section: ClassVar[str] = "model"
    name: ClassVar[str]
    structure: ClassVar[str] = "gradient"
    affine_in_inputs: ClassVar[bool] = True

    @abstractmethod
    def n_parameters(self, system: System) -> int:
        """Return the number q of parameters for a system."""

    def n_fixed_parameters(self, system: System) -> int:  # noqa: ARG002  # of most models, none
        """Return how many of them, the last ones, stay as they were drawn."""
        return 0

    @property
    def n_members(self) -> int:
        """Number of ensemble members (1 for a single network)."""
        return 1

    def n_member_parameters(self, system: System) -> int:
        """Return the number of parameters of one member, which a learning step or plan works on."""
        return self.n_parameters(system) // self.n_members

    @abstractmethod
    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        """Draw the initial parameters, (q,)."""

    def predict(
        self, system: System, parameters: Array, states: Array, inputs: Array | None = None
    ) -> Array:
        """Return the modelled accelerations, (N, r), of states, (N, d), with parameters (q,).

        The inputs, (N, m), count in a model that reads them; without any they are 0.
        """
        return self.predict_at(system, parameters, self.points(system, states, inputs))

    @abstractmethod
    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        """Return the modelled accelerations, (N, r), at :meth:`points`, with parameters (q,)."""

    def n_inputs_read(self, system: System) -> int:  # noqa: ARG002  # of most models, none
        """Return how many inputs the model depends on: all m, or none."""
        return 0

    def points(self, system: System, states: Array, inputs: Array | None = None) -> Array:
        """Return what the model depends on: states (N, d), or states and inputs, (N, d + m)."""
        return with_inputs(states, inputs, self.n_inputs_read(system))

    def features(self, system: System) -> tuple[Feature, ...]:
        """Return the p features of a point: of the state, then the inputs that the model reads."""
        first, m = system.n_states, self.n_inputs_read(system)
        return (*system.features, *(Feature("identity", first + j) for j in range(m)))

    def feature_scales(self, system: System) -> tuple[float, ...]:
        """Return the divisor of each feature: the system's scale, and γ for an input."""
        return (*system.feature_scales, *[system.gamma] * self.n_inputs_read(system))

    def featurize(self, system: System, points: Array) -> Array:
        """Return the features, (N, p), of points."""
        scales = self.feature_scales(system)
        values = feature_values(self.features(system), scales, np.moveaxis(points, -1, 0))
        return np.stack(values, axis=-1)
