"""Base class of policies that compare a finite set of candidate inputs."""

from __future__ import annotations

from dataclasses import dataclass

from dopt.fields import parameter
from dopt.policies.base import Array, Policy
from dopt.policies.sphere_directions import sphere_directions
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class CandidatePolicy(Policy):
    """A policy that compares candidate inputs.

    Parameters
    ----------
    candidates : int
        Inputs spread over the sphere ‖u‖ = γ; with one input there are two, ±γ.
    """

    candidates: int = parameter(16, "inputs", "positive")

    def compared_inputs(self, system: System) -> Array:
        """Return the candidates, (C, m), with norm γ."""
        return system.gamma * sphere_directions(system.n_inputs, self.candidates)
