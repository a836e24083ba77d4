"""A trial with its policy and learner as one argument of compiled functions.

Numba takes the structures of a trial apart at each call from Python, for half a millisecond; here
that is done once, and the functions below receive a pointer.
"""

from __future__ import annotations

from numba import types
from numba.experimental import structref

from dopt.kernel import loop
from dopt.kernel.compiler import called_from_python, compiled
from dopt.kernel.structs import Learn, Plan, Trial


@structref.register
class HeldTrialType(types.StructRef):  # type: ignore[misc]  # numba has no types
    """Type of :class:`HeldTrial` in compiled code."""


class HeldTrial(structref.StructRefProxy):  # type: ignore[misc]
    """A trial, the function of its policy and that of its learner."""

    trial: Trial
    plan: Plan
    learn: Learn


structref.define_proxy(HeldTrial, HeldTrialType, ["trial", "plan", "learn"])


@compiled
def hold(trial: Trial, plan: Plan, learn: Learn) -> HeldTrial:
    """Return a trial and its functions as one; it writes into the same arrays."""
    return HeldTrial(trial, plan, learn)


@called_from_python
def plan_input(held: HeldTrial, t: int) -> None:
    """Write u_t (:func:`dopt.kernel.loop.plan_input`)."""
    loop.plan_input(held.trial, held.plan, t)


@called_from_python
def take_in(held: HeldTrial, t: int, dt: float) -> bool:
    """Learn from the step from x_t to x_{t+1} (:func:`dopt.kernel.loop.take_in`).

    The loss of the step is the error of the accelerations before they are learned.
    """
    held.trial.record.loss[t] = loop.prediction_error(held.trial, t, dt)
    return loop.take_in(held.trial, held.learn, t, dt)
