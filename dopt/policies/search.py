"""Base class of policies that search for the best plan among a finite set."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from dopt.algorithm import Score
from dopt.errors import unknown_name
from dopt.fields import parameter
from dopt.policies.base import InformationPolicy
from dopt.policies.candidate_policy import CandidatePolicy
from dopt.systems.base import System

SCORES = {score.name.lower(): score for score in Score}
"""Scores by which plans are compared."""


@dataclass(frozen=True, kw_only=True)
class Search(CandidatePolicy, InformationPolicy):
    """Roll the learned model along every plan of a finite set and take the best plan's first input.

    From x_t the model runs x ← x + dt f_θ(x, u) without linearisation. The rows J at the states of
    the path, all r learned components of each, are what the plan would add to M; a score says what
    they are worth. The plan is made anew at each step. Among plans of equal score a random
    direction decides, as it does where every path leaves the bounds of a state: such a path has no
    score. M⁻¹ is held as a q × q matrix.

    With a time budget plans are scored one after the other until it is spent, opposite inputs in
    turn from a random one on, and the best so far is taken: the result then depends on the clock
    and on the machine. Without one it is deterministic. What all plans share, such as a copy of
    M⁻¹, and the first plan are not cut short: a budget below that is exceeded, and the first input
    is random.

    Parameters
    ----------
    candidates : int
        As of :class:`dopt.policies.candidate_policy.CandidatePolicy`.
    budget_us : float
        Time for the search of one step [µs]; 0 is no limit. The first plan is always scored.
    """

    kernel_function: ClassVar[str] = "dopt.kernel.search.plans.plan"
    reads_inputs: ClassVar[bool] = True

    budget_us: float = parameter(0.0, "µs", "nonnegative")

    @property
    @abstractmethod
    def score(self) -> str:
        """Criterion of a plan, one of ``SCORES``."""

    def steps(self, system: System) -> int:  # noqa: ARG002  # a longer plan depends on the system
        """Return the number of steps H of a plan."""
        return 1

    def chosen_form(self, n_parameters: int, n_rows: int) -> str:  # noqa: ARG002  # one form only
        return "primal"


def score_code(policy: Search) -> Score:
    """Return the code of a policy's score.

    Raises
    ------
    SpecificationError
        If there is no such score.
    """
    if policy.score not in SCORES:
        raise unknown_name(f"score of policy '{policy.name}'", policy.score, SCORES)
    return SCORES[policy.score]
