"""Episodic planner: sampled plans that are carried out for many steps before the next search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.errors import IncompatibleError
from dopt.fields import parameter
from dopt.policies.icem import ICEM
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class Episodic(ICEM):
    """Search for the best sequence of held inputs, and carry it out before the next search.

    The search is that of :class:`dopt.policies.icem.ICEM`, at step 1 and at the multiples of k.
    Between two searches the inputs are those of the best plan, whatever is observed. With k = H
    whole plans are carried out, as by the episodic D-optimal agent of M. Blanke and M. Lelarge,
    "FLEX: an adaptive exploration algorithm for nonlinear systems" (2023); with k < H and
    ``criterion`` "joint" it is the planner of M. Schultheis et al., "Receding horizon curiosity"
    (2019), with other models. Where every plan of a search leaves the bounds, the first input after
    it is random.

    Parameters
    ----------
    lookahead : int
        Steps H of a plan.
    replan_every : int
        Steps k from one search to the next, at most H.
    """

    name: ClassVar[str] = "episodic"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.search.episodes.plan"

    lookahead: int = parameter(50, "steps", "positive")
    replan_every: int = parameter(50, "steps", "positive")

    def check(self, system: System) -> None:
        super().check(system)
        if self.replan_every > self.lookahead:
            raise IncompatibleError(
                f"policy.replan_every is {self.replan_every} steps, but the plans have "
                f"{self.lookahead}: make it smaller, or policy.lookahead larger."
            )

    def last_search(self, t: int) -> int:
        """Return the last step up to t ≥ 1 at which plans are drawn."""
        return max(1, t - t % self.replan_every)

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:
        numbers = super().kernel_numbers(n_parameters, regularization)
        return *numbers, float(self.replan_every)
