"""Base class of policies that predict candidate inputs held over several steps."""

from __future__ import annotations

from dataclasses import dataclass

from dopt.fields import parameter
from dopt.policies.base import ClosedLoop, check_length
from dopt.policies.search import CandidatePolicy
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class HeldCandidates(CandidatePolicy, ClosedLoop):
    """Predict where each of some inputs leads if it is held, and apply the best of them.

    Parameters
    ----------
    lookahead : int
        Steps for which a candidate is held in prediction.
    candidates : int
        As of :class:`dopt.policies.search.CandidatePolicy`.
    """

    lookahead: int = parameter(1, "steps", "positive")

    def check(self, system: System) -> None:
        check_length("policy.lookahead", self.lookahead, system)
