"""Candidate inputs that are held in prediction: the frame of two baselines of the literature."""

from __future__ import annotations

from dataclasses import dataclass

from dopt.fields import quantity
from dopt.policies.base import Array, ClosedLoop, check_length
from dopt.policies.directions import sphere_inputs
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class HeldCandidates(ClosedLoop):
    """Predict where each of some inputs leads if it is held, and apply the best of them.

    Parameters
    ----------
    lookahead : int
        Steps for which a candidate is held in prediction.
    candidates : int
        Inputs on the sphere that are compared (two if there is but one input).
    """

    lookahead: int = quantity(1, "steps", "positive")
    candidates: int = quantity(16, "inputs", "positive")

    def check(self, system: System) -> None:
        check_length("policy.lookahead", self.lookahead, system)

    def compared_inputs(self, system: System) -> Array:
        """Return the candidates, (C, m), with norm γ."""
        return sphere_inputs(system, self.candidates)
