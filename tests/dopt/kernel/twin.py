"""Functions and steps of the kernel called singly."""

from __future__ import annotations

from types import FunctionType
from typing import Any

import numpy as np
from numba import float64, int64
from numba.core.dispatcher import Dispatcher

from dopt.kernel.held import HeldTrial, trial_in
from dopt.kernel.linear_algebra import dense
from dopt.kernel.loop import advance
from dopt.kernel.pointers import compiled_for, held_kind, kind_of
from dopt.kernel.run import KernelSteps, KernelTrial, NumpyParts
from dopt.kernel.structs import Evaluation
from dopt.spec.trial import TrialSpec
from dopt.trial_view import TrialView
from dopt.types import Array, CompiledFunction, Matrix
from tests.dopt.custom_plugins import kept


def relative_gap(values: Array, expected: Array) -> float:
    """Return the largest difference between two arrays beside the largest entry."""
    return float(np.abs(values - expected).max() / np.abs(expected).max())


def check_inverse(trial: KernelTrial, M: Array, atol: float) -> None:
    """Check that a trial holds M⁻¹ up to rounding."""
    product = dense(trial.state.covariance) @ M
    np.testing.assert_allclose(product, np.eye(len(M)), rtol=0.0, atol=atol)


def call(function: CompiledFunction, *arguments: Any) -> Any:
    """Call a compiled function with pointers to the equations of a plant, as a trial does.

    Python's own call would compile it for each system, in every process, for seconds each time.
    Behind pointers one compilation serves all systems, and the cache of the kernel keeps it.
    """
    kinds = tuple(map(kind_of, arguments))
    return compiled_for(function, kinds)(*arguments)


def interpreted(function: CompiledFunction) -> Any:
    """Return a compiled function, and all that it calls, as plain Python.

    For what holds of its source; what the compiler makes of it is tested by whole trials.
    """
    plain: FunctionType = function.py_func
    used = {name: plain.__globals__.get(name) for name in plain.__code__.co_names}
    called = {name: interpreted(one) for name, one in used.items() if isinstance(one, Dispatcher)}
    called |= {name: one.plain for name, one in used.items() if hasattr(one, "plain")}
    copy = FunctionType(plain.__code__, {**plain.__globals__, **called}, plain.__name__)
    copy.__defaults__, copy.__kwdefaults__ = plain.__defaults__, plain.__kwdefaults__
    return copy


def model_of_kernel(spec: TrialSpec, parameters: Array | None = None) -> TrialView:
    """Return what a policy of one's own can ask of the model, in the code that is compiled for it.

    The parameters are those given, or the initial ones.
    """
    steps = KernelSteps(spec)
    if parameters is not None:
        steps.trial.state.theta[:] = parameters
    return NumpyParts(steps)._view(0)


@kept
def record(held: HeldTrial, points: Evaluation, first: int, parameters: Matrix) -> int:
    for i in range(parameters.shape[0]):
        done = advance(held, points, first + i, first + i + 1)
        if done <= first + i:
            return done
        parameters[i] = trial_in(held).state.theta
    return first + parameters.shape[0]


def run(fast: KernelTrial, steps: int) -> np.ndarray:
    """Take steps one by one; return the parameters after each, (steps, q).

    Compiled code calls the loop: from Python, each call would take as long as a step.
    """
    parameters = np.empty((steps, len(fast.state.theta)))
    kinds = (held_kind(fast.trial), kind_of(fast.points), int64, float64[:, ::1])
    last = fast.done + steps
    fast.done = compiled_for(record, kinds)(fast.held, fast.points, fast.done, parameters)
    assert fast.done == last, "the trial has diverged"
    return parameters
