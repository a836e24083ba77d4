"""Periodic input at the eigenfrequency of the system."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.declare.validated_fields import parameter
from dopt.errors import IncompatibleError
from dopt.policies.base import Array, OpenLoop
from dopt.systems.base import System
from dopt.systems.equilibrium import eigenmode


@dataclass(frozen=True, kw_only=True)
class Periodic(OpenLoop):
    """u_t = γ sin(ω t dt) e (section 3), with e the input direction that drives the mode most.

    Parameters
    ----------
    frequency : float or None
        Angular frequency ω [rad/s]; None takes the damped eigenfrequency of the least damped
        oscillation about the stable equilibrium.
    """

    name: ClassVar[str] = "periodic"
    uses_full_amplitude: ClassVar[bool] = False

    frequency: float | None = parameter(None, "rad/s", "positive")

    def check(self, system: System) -> None:
        if eigenmode(system) is None:
            raise IncompatibleError(
                f"policy 'periodic' needs an eigenmode, but env '{system.name}' with these "
                f"parameters has no oscillation about a stable equilibrium: choose another policy."
            )

    def inputs(self, system: System, rng: np.random.Generator) -> Array:  # noqa: ARG002  # nothing is random here
        mode = eigenmode(system)
        assert mode is not None, "check() is called before"
        frequency = mode.frequency if self.frequency is None else self.frequency
        times = system.dt * np.arange(system.horizon)
        wave: Array = system.gamma * np.sin(frequency * times)[:, None] * mode.direction
        return wave
