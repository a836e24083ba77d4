"""V-optimal exploration: the smallest predictive variance at the states of a task."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.errors import IncompatibleError
from dopt.fields import parameter
from dopt.policies.search import Search
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox


@dataclass(frozen=True, kw_only=True)
class TaskOptimal(Search):
    """Maximise the decrease of the predictive variance summed over states that matter to a task.

    With G the rows of the Jacobian at these states and V = J M⁻¹, the decrease by the rows J at
    x_t + dt f_θ(x_t, u) is tr((I + V Jᵀ)⁻¹ V GᵀG Vᵀ): V-optimal design. The states are drawn once
    for all from the evaluation box or the reachable set, with weights exp(-δ²/2) that fall with
    the distance δ to the goal (:func:`dopt.policies.task_states.task_states`). Reference:
    A. Atkinson, A. Donev and R. Tobias, "Optimum experimental designs" (2007), chapter 10.

    Parameters
    ----------
    states : {"grid", "reachable"}
        Where the states are drawn from: the box of the evaluation grid, or the states that the true
        system visits under strong inputs, which takes the true system to know.
    count : int
        Number of states.
    goal : tuple of float
        State of the task, in its d components; empty weighs all states alike.
    radius : float
        Distance to the goal at which the weight is e^(-1/2), in half-widths of the grid.
    """

    name: ClassVar[str] = "task"
    compiled: ClassVar[bool] = True

    states: str = parameter("grid", choices=("grid", "reachable"))
    count: int = parameter(32, "states", "positive")
    goal: tuple[float, ...] = parameter(())
    radius: float = parameter(0.5, "half-widths", "positive")

    @property
    def score(self) -> str:
        return "task"

    def check(self, system: System) -> None:
        if self.states == "reachable" and isinstance(system, BlackBox):
            raise IncompatibleError(
                f"policy.states is 'reachable', but where env '{system.name}' can be driven is not "
                f"known without its equations: set it to grid."
            )
        if self.goal and len(self.goal) != system.n_states:
            raise IncompatibleError(
                f"policy.goal has {len(self.goal)} entries, but a state of env '{system.name}' has "
                f"{system.n_states}: give one for each of them, or none."
            )
