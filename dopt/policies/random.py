"""Random inputs: Gaussian of maximal energy, on the sphere, and held on the sphere."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.policies.base import Array, OpenLoop, on_sphere
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class RandomGaussian(OpenLoop):
    """u_t ~ N(0, (γ²/m) I), the paper's random policy (section 3).

    Its mean energy is γ²; single inputs exceed the bound, as in the paper's own definition.
    """

    name: ClassVar[str] = "random"
    exceeds: ClassVar[bool] = True

    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        shape = (system.horizon, system.n_inputs)
        deviation = system.gamma / math.sqrt(system.n_inputs)
        return deviation * rng.standard_normal(shape)


@dataclass(frozen=True, kw_only=True)
class RandomSphere(OpenLoop):
    """u_t uniform on the sphere ‖u‖ = γ, independent from step to step."""

    name: ClassVar[str] = "random_sphere"

    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        shape = (system.horizon, system.n_inputs)
        return on_sphere(rng.standard_normal(shape), system.gamma)


@dataclass(frozen=True, kw_only=True)
class RandomHeld(OpenLoop):
    """Uniform on the sphere ‖u‖ = γ, each draw held for a number of steps.

    Parameters
    ----------
    hold : int
        Steps for which an input is held.
    """

    name: ClassVar[str] = "random_held"

    hold: int = parameter(10, "steps", "positive")

    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        draws = rng.standard_normal((-(-system.horizon // self.hold), system.n_inputs))
        held = np.repeat(on_sphere(draws, system.gamma), self.hold, axis=0)
        return np.ascontiguousarray(held[: system.horizon])
