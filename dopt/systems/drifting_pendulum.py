"""Pendulum whose friction changes with time, while the system is explored."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.declare.validated_fields import parameter
from dopt.systems.base import Array
from dopt.systems.pendulum import Pendulum


@dataclass(frozen=True, kw_only=True)
class DriftingPendulum(Pendulum):
    """The pendulum with a friction that tends to another value, b(t) = b∞ + (b₀ - b∞) exp(-t/τ).

    The model is not told the time. The loss of step t is that against the accelerations at the time
    t dt of the step.

    Parameters
    ----------
    friction : float
        Viscous friction coefficient b₀ of the pivot at t = 0 [N m s].
    final_friction : float
        Coefficient b∞ of the worn pivot [N m s].
    time_constant : float
        τ [s].
    """

    name: ClassVar[str] = "drifting_pendulum"

    horizon: int = parameter(1000, "steps", "positive")
    final_friction: float = parameter(0.5, "N m s", "nonnegative")
    time_constant: float = parameter(5.0, "s", "positive")

    @functools.cached_property
    def history(self) -> Array:
        """Physical parameters of each step, (T, number of them)."""
        rows = np.tile(np.array(self.parameters), (self.horizon, 1))
        worn = -np.expm1(-self.dt * np.arange(self.horizon) / self.time_constant)
        growth = (self.final_friction - self.friction) * worn
        rows[:, self.physical.index("friction")] += growth
        return rows
