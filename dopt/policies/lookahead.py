"""Look-ahead: inputs that are held, or switched once, along the learned model's path."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from dopt.errors import IncompatibleError
from dopt.fields import parameter
from dopt.policies.base import check_length
from dopt.policies.search import Search
from dopt.systems.base import System
from dopt.systems.properties import eigenmode

PERIOD_SHARE = 0.6
STEPS_WITHOUT_PERIOD = 10
STATES_OF_A_PATH = 5


@dataclass(frozen=True, kw_only=True)
class Lookahead(Search):
    """Score "hold u" and "hold u for H/2 steps, then u'" over all candidates u and u'.

    One step is blind where an input acts through an integrator: a rotation moves a quadrotor
    sideways only later. The first input of the best of the C² plans is applied, and the plan is
    made anew at the next step.

    Parameters
    ----------
    lookahead : int or None
        H; None takes 0.6 periods of the least damped oscillation about the stable equilibrium, and
        10 steps where there is none. The period is the true system's, as that of the periodic
        policy is: give H where it is unknown.
    criterion : {"joint", "sum"}
        ``joint`` is log det(I + J M⁻¹ Jᵀ) of all rows along the path, ``sum`` that of each state's
        rows alone, summed over the path.
    stride : int or None
        Every how many steps a state's rows are taken; in ``joint`` each counts so many times. None
        takes a fifth of the plan's steps: neighbouring rows are nearly the same.
    """

    name: ClassVar[str] = "lookahead"
    compiled: ClassVar[bool] = True

    candidates: int = parameter(8, "inputs", "positive")
    lookahead: int | None = parameter(None, "steps", "positive")
    criterion: str = parameter("sum", choices=("joint", "sum"))
    stride: int | None = parameter(None, "steps", "positive")

    def check(self, system: System) -> None:
        if self.lookahead is not None:
            check_length("policy.lookahead", self.lookahead, system)
        if self.stride is not None and self.stride > self.steps(system):
            raise IncompatibleError(
                f"policy.stride is {self.stride} steps, but the plans have {self.steps(system)}: "
                f"make it smaller, or policy.lookahead larger."
            )

    @property
    def score(self) -> str:
        return self.criterion

    def steps(self, system: System) -> int:
        if self.lookahead is not None:
            return self.lookahead
        mode = eigenmode(system)
        if mode is None:
            return STEPS_WITHOUT_PERIOD
        return max(1, round(PERIOD_SHARE * 2 * math.pi / mode.frequency / system.dt))

    def stride_of(self, system: System) -> int:
        """Return every how many steps of a plan a state's rows are taken."""
        if self.stride is not None:
            return self.stride
        return max(1, self.steps(system) // STATES_OF_A_PATH)
