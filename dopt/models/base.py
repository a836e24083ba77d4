"""Base class of model specifications."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from dopt.declare.kernel_support import KernelSupport
from dopt.systems.base import System

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Model(KernelSupport):
    """A parametric model of the r learned accelerations of a system.

    ``structure`` says how its parameters can be learned: by gradient, by least squares because the
    model is linear in them, by conditioning on all samples, or by fits of one network of an
    ensemble after the other. A learner names the one it teaches.
    """

    section: ClassVar[str] = "model"
    name: ClassVar[str]
    structure: ClassVar[str] = "gradient"

    @abstractmethod
    def n_parameters(self, system: System) -> int:
        """Return the number q of parameters for a system."""

    def n_fixed_parameters(self, system: System) -> int:  # noqa: ARG002  # of most models, none
        """Return how many of them, the last ones, stay as they were drawn."""
        return 0

    @property
    def n_members(self) -> int:
        """Number of networks that take turns in learning steps and plans, 1 but for ensembles."""
        return 1

    def n_member_parameters(self, system: System) -> int:
        """Return how many parameters a learning step and a plan work on: those of one member."""
        return self.n_parameters(system) // self.n_members

    @abstractmethod
    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        """Draw the initial parameters, (q,)."""

    @abstractmethod
    def predict(self, system: System, parameters: Array, states: Array) -> Array:
        """Return the modelled accelerations, (N, r), of states, (N, d), with parameters (q,)."""
