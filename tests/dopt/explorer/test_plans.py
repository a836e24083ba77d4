"""Plans that nobody asked for, plans that fail, and Ctrl-C during a call that fails."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from dopt import Explorer
from dopt.errors import SpecificationError
from dopt.explorer.explorer import uninterrupted
from dopt.policies.base import CustomPolicy, Planner
from dopt.systems import System
from dopt.trial_view import TrialView
from dopt.types import Array
from tests.dopt.explorer.plants import MOTOR, following
from tests.dopt.explorer.test_explorer import SHORT, explored
from tests.waiting import PATIENCE_SECONDS


@dataclass(frozen=True, kw_only=True)
class Remembering(CustomPolicy):
    """Notes the steps at which it is asked for an input."""

    name: ClassVar[str] = "remembering"
    steps: ClassVar[list[int]] = []

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002
        return RememberingPlanner()


class RememberingPlanner(Planner):
    def choose(self, view: TrialView) -> Array:
        Remembering.steps.append(view.t)
        return np.zeros(1)


def told_without_questions(policy: str | dict[str, Any], steps: int) -> tuple[Explorer, Array]:
    """Return an exploration of inputs that were chosen elsewhere, and its last state."""
    explorer, x = Explorer(MOTOR, policy=policy, steps=30), np.array([0.1, 0.0])
    explorer.ask(x)
    for t in range(steps):
        u = np.array([3.0 * (-1) ** t])
        x = following(x, u)
        assert explorer.tell(x, applied=u)
    return explorer, x


def test_a_policy_that_may_remember_plans_at_each_step_also_where_none_is_asked() -> None:
    Remembering.steps.clear()
    told_without_questions({"_target_": f"{__name__}.Remembering"}, 5)
    assert Remembering.steps == [1, 2, 3, 4]


def test_episodes_are_planned_before_the_first_question() -> None:
    policy = {**SHORT, "name": "episodic", "replan_every": 5}
    explorer, x = told_without_questions(policy, 2)
    assert abs(explorer.ask(x)[0]) > 0.1


@pytest.mark.parametrize("deadline", [None, PATIENCE_SECONDS])
def test_a_plan_that_fails_is_said_once_and_costs_no_state(deadline: float | None) -> None:
    explorer = Explorer(MOTOR, policy="d_optimal", steps=30, deadline=deadline)
    x = explored(explorer, 3)
    planner: Any = explorer._planner
    make, planner._make = planner._make, _failing
    with pytest.raises(RuntimeError, match="no plan"):
        explorer.ask(x)
    planner._make = make
    assert explorer.tell(following(x, np.array([1.0])), applied=[1.0])
    explorer.close()


def _failing() -> None:
    raise RuntimeError("no plan")


def test_ctrl_c_during_a_call_that_fails_is_not_lost() -> None:
    @uninterrupted()
    def fail() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        raise SpecificationError("a shape is wrong")

    with pytest.raises(KeyboardInterrupt):
        fail()
