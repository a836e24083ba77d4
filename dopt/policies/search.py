"""Search for the best plan among a finite set: the frame of the policies beyond D-optimal."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

from dopt.fields import quantity
from dopt.policies.base import Informed
from dopt.policies.compared import Compared
from dopt.systems.base import System

SCORES = ("joint", "sum", "trace", "a", "e", "task")
"""What a plan is judged by; in the order of the compiled kernel."""


@dataclass(frozen=True, kw_only=True)
class Search(Compared, Informed):
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
        As of :class:`dopt.policies.compared.Compared`.
    budget_us : float
        Time for the search of one step [µs]; 0 is no limit. The first plan is always scored.
    """

    budget_us: float = quantity(0.0, "µs", "nonnegative")

    @property
    @abstractmethod
    def score(self) -> str:
        """What a plan is judged by, one of ``SCORES``."""

    def steps(self, system: System) -> int:  # noqa: ARG002  # a longer plan depends on the system
        """Return the number of steps H of a plan."""
        return 1

    def chosen_form(self, n_parameters: int, n_rows: int) -> str:  # noqa: ARG002  # one form only
        return "primal"
