"""Plan and update of a trial, written in numpy."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, TypeVar

import numpy as np

from dopt.arguments import as_array
from dopt.control.task import Feedback
from dopt.errors import IncompatibleError, SpecificationError
from dopt.learning import LEARNERS, Adam
from dopt.learning.base import CustomLearner, Updater
from dopt.models import MLP
from dopt.policies import POLICIES, Disagreement
from dopt.policies.base import Array, CustomPolicy, Planner, TaskPolicy
from dopt.randomness import stream
from dopt.registry import check_returned
from dopt.spec.trial import TrialSpec
from dopt.trial_view import TrialView

T = TypeVar("T")

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
        method, make = "task_planner", partial(policy.task_planner, system, spec.config.goal, rng)
    else:
        method, make = "planner", partial(policy.planner, system, rng)
    if type(policy) in POLICIES.values():
        return make()
    return _Checked(policy.name, _made(f"policy '{policy.name}'", method, make, Planner))


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
    make = partial(learner.updater, spec.system, stream(spec.seed, "updater"))
    return _made(f"learner '{learner.name}'", "updater", make, Updater)


def _made(whose: str, method: str, make: Callable[[], T], base: type) -> T:
    """Return what a method of a user's class makes, or raise ``SpecificationError``."""
    try:
        found = make()
    except TypeError as error:
        if "abstract" not in str(error):
            raise
        raise SpecificationError(
            f"{method}() of {whose} makes an object that lacks a method ({error}): define it."
        ) from error
    check_returned(whose, method, found, base)
    return found


def check_custom_parts(specs: Iterable[TrialSpec]) -> None:
    """Make one plan and one update of each user's class among the policies and learners.

    Other errors are left to the trials, as they may concern some trials only.

    Raises
    ------
    SpecificationError
        If a method is missing, in the plan or the update or in what should be one.
    """
    shipped = (*POLICIES.values(), *LEARNERS.values())
    own = {type(part): (part, spec) for spec in specs for part in (spec.policy, spec.learner)}
    for kind, (part, spec) in own.items():
        if kind in shipped:
            continue
        try:
            custom_planner(spec) if part is spec.policy else custom_updater(spec)
        except SpecificationError as error:
            if not isinstance(error, IncompatibleError):
                raise
        except Exception:
            continue


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
