"""Candidate inputs that are held in prediction: the frame of two baselines of the literature."""

from __future__ import annotations

from dataclasses import dataclass

from dopt.fields import quantity
from dopt.policies.base import ClosedLoop, check_length
from dopt.policies.compared import Compared
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class HeldCandidates(Compared, ClosedLoop):
    """Predict where each of some inputs leads if it is held, and apply the best of them.

    Parameters
    ----------
    lookahead : int
        Steps for which a candidate is held in prediction.
    candidates : int
        As of :class:`dopt.policies.compared.Compared`.
    """

    lookahead: int = quantity(1, "steps", "positive")

    def check(self, system: System) -> None:
        check_length("policy.lookahead", self.lookahead, system)
