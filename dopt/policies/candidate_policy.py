"""A finite set of candidate inputs, for objectives that are compared and not solved."""

from __future__ import annotations

from dataclasses import dataclass

from dopt.fields import quantity
from dopt.policies.base import Array, Policy
from dopt.policies.directions import sphere_directions
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class Compared(Policy):
    """A policy that compares candidate inputs.

    Parameters
    ----------
    candidates : int
        Inputs spread over the sphere ‖u‖ = γ; with one input there are two, ±γ.
    """

    candidates: int = quantity(16, "inputs", "positive")

    def compared_inputs(self, system: System) -> Array:
        """Return the candidates, (C, m), with norm γ."""
        return system.gamma * sphere_directions(system.n_inputs, self.candidates)
