"""Calls of single functions of the kernel, without the seconds that Numba takes to compile them."""

from __future__ import annotations

from types import FunctionType
from typing import Any

from numba.core.dispatcher import Dispatcher

from dopt.kernel.pointers import compiled_for, kind_of, path_of
from dopt.kernel.steps import KernelSteps, NumpyParts
from dopt.spec.trial import TrialSpec
from dopt.trial_view import TrialView
from dopt.types import Array, CompiledFunction


def call(function: CompiledFunction, *arguments: Any) -> Any:
    """Call a compiled function with pointers to the equations of a plant, as a trial does.

    Python's own call would compile it for each system, in every process, for seconds each time.
    Behind pointers one compilation serves all systems, and the cache of the kernel keeps it.
    """
    kinds = tuple(map(kind_of, arguments))
    return compiled_for(path_of(function), function, kinds)(*arguments)


def interpreted(function: CompiledFunction) -> Any:
    """Return a compiled function, and all that it calls, as plain Python.

    For what holds of its source; what the compiler makes of it is tested by whole trials.
    """
    plain: FunctionType = function.py_func
    used = {name: plain.__globals__.get(name) for name in plain.__code__.co_names}
    called = {name: interpreted(one) for name, one in used.items() if isinstance(one, Dispatcher)}
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
    return NumpyParts(spec, steps.trial, steps._held)._view(0)
