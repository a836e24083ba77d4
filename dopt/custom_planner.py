"""Plan and update of a trial, written in numpy."""

from __future__ import annotations

from typing import Any

import numpy as np

from dopt.arguments import as_array
from dopt.control.task import Feedback
from dopt.errors import SpecificationError
from dopt.learning import Adam
from dopt.learning.base import CustomLearner, Updater
from dopt.models import MLP
from dopt.policies import POLICIES, Disagreement
from dopt.policies.base import Array, CustomPolicy, Planner, TaskPolicy
from dopt.randomness import stream
from dopt.registry import check_returned
from dopt.spec.trial import TrialSpec
from dopt.trial_view import TrialView

OVERFLOWING = 1e30
"""Size of a parameter from which on a plan may overflow that is right."""


def custom_planner(spec: TrialSpec) -> Planner | None:
    """Return a new plan of a trial; None where the policy brings none.

    Raises
    ------
    SpecificationError
        If a user's policy returns something else.
    """
    policy, system, rng = spec.policy, spec.system, stream(spec.seed, "planner")
    if not isinstance(policy, CustomPolicy):
        return None
    if isinstance(policy, Disagreement) and isinstance(spec.model, MLP):
        assert isinstance(spec.learner, Adam)
        return policy.network_planner(system, spec.model, spec.learner, rng)
    if isinstance(policy, TaskPolicy):
        method, plan = "task_planner", policy.task_planner(system, spec.config.goal, rng)
    else:
        method, plan = "planner", policy.planner(system, rng)
    if type(policy) in POLICIES.values():
        return plan
    check_returned(f"policy '{policy.name}'", method, plan, Planner)
    return _Checked(policy.name, plan)


def custom_updater(spec: TrialSpec) -> Updater | None:
    """Return a new update of a trial; None where the learner brings none.

    Raises
    ------
    SpecificationError
        If a user's learner returns something else.
    """
    learner = spec.learner
    if not isinstance(learner, CustomLearner):
        return None
    updater = learner.updater(spec.system, stream(spec.seed, "updater"))
    check_returned(f"learner '{learner.name}'", "updater", updater, Updater)
    return updater


class _Checked(Planner):
    """A user's plan, whose inputs are finite numbers or refused."""

    def __init__(self, name: str, plan: Planner) -> None:
        self._name, self._plan = name, plan

    def choose(self, view: TrialView) -> Array:
        """Return the input that the plan chooses.

        Raises
        ------
        SpecificationError
            If it is no array of real numbers, or not finite while the model still is sound.
        """
        given: Any = self._plan.choose(view)
        chosen = as_array(given)
        if chosen.dtype.kind in "fiu" and (
            np.isfinite(chosen).all() or not np.abs(view.parameters).max() < OVERFLOWING
        ):
            return chosen
        shown = " ".join(repr(given).split())
        raise SpecificationError(
            f"choose() of the planner of policy '{self._name}' returned {shown[:80]} at step "
            f"{view.t}, but an input of finite real numbers, shape {(view.system.n_inputs,)}, is "
            f"expected: correct its choose()."
        )

    def observe(self, view: TrialView) -> None:
        self._plan.observe(view)

    def feedback(self) -> Feedback | None:
        return self._plan.feedback()
