"""Compilation of the loop and of the parts of a trial that it calls through function pointers.

The loop is compiled once for all systems, models, policies and learners; a policy, a learner or a
form of the information matrix is compiled when a trial first needs it.
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable, Hashable
from typing import NamedTuple

import numba
import numpy as np
from numba import float64, int64, types
from numba.core.errors import NumbaError

from dopt.errors import SpecificationError
from dopt.kernel.cache import one_compiler_at_a_time
from dopt.kernel.equations import ACCELERATIONS, COMPLEX_ACCELERATIONS, KNOWN
from dopt.kernel.loop import advance
from dopt.kernel.structs import Evaluation, Information, Network, Plant, State, Trial
from dopt.kernel.user_code import compiled_own
from dopt.learning.base import CompiledLearner, Learner
from dopt.policies.base import CompiledPolicy, Policy
from dopt.types import CompiledFunction, NumbaType


class Compiled(NamedTuple):
    """Compiled code of a trial."""

    advance: Callable[..., int]
    plan: CompiledFunction
    learn: CompiledFunction


def compiled_trial(policy: Policy, learner: Learner, trial: Trial, points: Evaluation) -> Compiled:
    """Compile the loop for a trial, with the functions of its policy and its learner."""
    key = (layout_of(trial), layout_of(points), _source(policy), _source(learner))
    if key not in _trials:
        plan, learn = signatures(trial)
        compile_information(trial, trial.information)
        loop = compiled_loop(trial, points)
        _trials[key] = Compiled(loop, function_of(policy, plan), function_of(learner, learn))
    return _trials[key]


_trials: dict[Hashable, Compiled] = {}


def layout_of(value: object) -> Hashable:
    """Return what the type of an argument for Numba depends on, which takes longer to find out."""
    if isinstance(value, tuple):
        return (type(value), *map(layout_of, value))
    if isinstance(value, np.ndarray):
        return value.dtype.char, value.ndim, value.flags.num
    return type(value) if isinstance(value, (int, float)) else value


def _source(part: Policy | Learner) -> str | Callable[..., None]:
    """Return the path of the function of a policy or a learner, or a user's own function."""
    if isinstance(part, CompiledPolicy):
        return part.plan
    return part.learn if isinstance(part, CompiledLearner) else part.kernel_function


def compile_information(trial: Trial, information: Information) -> None:
    """Compile the functions of a form in which a trial may hold M."""
    kinds = _information_signatures(trial.plant, trial.network, trial.state)
    for function, signature in zip(information, kinds, strict=True):
        path = f"{function.__module__}.{function.__name__}"
        compiled_for(path, function, signature.args)


def _information_signatures(
    plant: Plant, network: Network, state: State
) -> tuple[NumbaType, NumbaType]:
    given = (*map(kind_of, (plant, network, state)), float64[::1])
    return types.void(*given), float64[:, ::1](*given, float64[:, ::1], int64)


def signatures(trial: Trial) -> tuple[NumbaType, NumbaType]:
    """Return the types of the functions of a policy and of a learner."""
    plan = learn = types.void(kind_of(trial), int64, float64[::1])
    return plan, learn


def compiled_loop(trial: Trial, points: Evaluation) -> Callable[..., int]:
    """Compile the loop for a trial, with pointers to the functions of its policy and learner."""
    given = (kind_of(trial), kind_of(points), *map(pointer, signatures(trial)))
    return compiled_for("loop", advance, (*given, int64, int64))


def function_of(part: Policy | Learner, signature: NumbaType) -> CompiledFunction:
    """Return the compiled function of a policy or a learner.

    Raises
    ------
    SpecificationError
        If its class names none, or one that does not exist or does not compile.
    """
    source = _source(part)
    if not isinstance(source, str):
        return _own(part, source, signature)
    try:
        return compiled_at(source, signature)
    except (ImportError, AttributeError, ValueError) as error:
        raise SpecificationError(
            f"{part.section} '{part.name}' names the kernel function '{source}', which cannot be "
            f"imported ({error}): set kernel_function in its class to the path of one."
        ) from error


def compiled_at(path: str, signature: NumbaType) -> CompiledFunction:
    """Compile the function of the package at a dotted path."""
    module, _, name = path.rpartition(".")
    function = getattr(importlib.import_module(module), name)
    compiled_for(path, function, signature.args)
    return function


def _own(
    part: Policy | Learner, function: Callable[..., None], signature: NumbaType
) -> CompiledFunction:
    """Compile the function of a user's own policy or learner."""
    try:
        return compiled_own(function, signature)
    except NumbaError as error:
        reason = next((line for line in str(error).splitlines()[1:] if line.strip()), str(error))
        raise SpecificationError(
            f"{function.__name__}() of {part.section} '{part.name}' does not compile "
            f"({reason.strip()}): write it with numbers, arrays and loops that Numba compiles, and "
            f"functions of dopt.kernel."
        ) from error


def kind_of(value: object) -> NumbaType:
    """Return the type of an argument for numba; of a compiled function, that of a pointer to it."""
    if not isinstance(value, tuple):
        return numba.typeof(value)
    if isinstance(value, Plant):
        equations = (KNOWN, ACCELERATIONS, COMPLEX_ACCELERATIONS)
        kinds = [*map(pointer, equations), *map(kind_of, value[len(equations) :])]
    elif isinstance(value, Trial):
        functions = _information_signatures(value.plant, value.network, value.state)
        information = types.NamedTuple([*map(pointer, functions)], Information)
        kinds = [information if isinstance(part, Information) else kind_of(part) for part in value]
    else:
        kinds = [*map(kind_of, value)]
    return types.NamedTuple(kinds, type(value))


def pointer(signature: NumbaType) -> NumbaType:
    """Return the type of a pointer to functions of a signature."""
    return types.FunctionType(signature)


def compiled_for(
    name: str, function: CompiledFunction, kinds: tuple[NumbaType, ...]
) -> Callable[..., int]:
    """Return the machine code of a function for types of arguments; compile it unless it is."""
    if (name, kinds) not in _done:
        with one_compiler_at_a_time(
            f"{name}-{hashlib.sha256(str(kinds).encode()).hexdigest()[:16]}"
        ):
            _done[name, kinds] = function.compile(kinds)
    return _done[name, kinds]


_done: dict[tuple[str, tuple[NumbaType, ...]], Callable[..., int]] = {}
