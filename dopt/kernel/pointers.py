"""Compilation of the loop and of the functions that it calls through pointers.

The loop is compiled once for all systems, models, policies and learners; a policy, a learner or a
form of the information matrix is compiled when a trial first needs it.
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, cast

import numba
import numpy as np
from numba import float64, int64, types
from numba.core.errors import NumbaError

from dopt.algorithm import Integrator
from dopt.errors import SpecificationError
from dopt.kernel import integration, limits, loop, sensors
from dopt.kernel.cache import compile_missing, one_compiler_at_a_time
from dopt.kernel.compiler import compiled_own
from dopt.kernel.equations import ACCELERATIONS, COMPLEX_ACCELERATIONS, KNOWN
from dopt.kernel.held import FIELDS, HeldTrialType, hold, pointer_to
from dopt.kernel.plain import PLAIN
from dopt.kernel.structs import Evaluation, Information, Network, Plant, State, Steps, Trial
from dopt.learning.base import CompiledLearner, Learner
from dopt.policies.base import CompiledPolicy, Policy
from dopt.types import CompiledFunction, NumbaType


def layout_of(value: object) -> Hashable:
    """Return a cheap key of an argument's type for Numba."""
    if isinstance(value, tuple):
        return (type(value), *map(layout_of, value))
    if isinstance(value, np.ndarray):
        return value.dtype.char, value.ndim, value.flags.num
    return type(value) if isinstance(value, (int, float)) else value


class Compiled(NamedTuple):
    """Compiled code of a trial: what its steps call, and what calls them."""

    steps: Steps
    callers: list[Callable[..., Any]]


def compiled_trial(
    policy: Policy,
    learner: Learner,
    trial: Trial,
    callers: tuple[CompiledFunction, ...],
    points: Evaluation | None = None,
    others: tuple[CompiledFunction, ...] = (),
) -> Compiled:
    """Compile ``callers`` for a trial, with the functions of its policy and its learner.

    What is missing in the cache of ``others`` is compiled beside them.
    """
    kinds = layout_of((trial, points, *_others(trial).values()))
    key = (kinds, callers, others, _source(policy), _source(learner))
    if key not in _trials:
        steps = _compiled_parts(policy, learner, trial, [*callers, *others])
        _trials[key] = Compiled(steps, [compiled_step(trial, one, points) for one in callers])
    return _trials[key]


_trials: dict[Hashable, Compiled] = {}

STEPS = (hold, loop.plan_next, loop.take_in_next)
"""Functions of steps one by one, which do not depend on the policy and the learner."""


OTHER_STEPS = {
    "limit_input": (loop.do_nothing, limits.limit_input),
    "note_error": (loop.do_nothing, limits.note_error),
    "estimate_state": (loop.keep_state, sensors.estimate_state),
    "observe": (integration.observe_euler, integration.observe_runge_kutta),
}
"""Functions of a trial's steps beside its policy and learner: the usual one, and the other."""


def other_steps(limited: bool, measured: bool, integrator: int) -> dict[str, CompiledFunction]:
    """Return which of :data:`OTHER_STEPS` a trial calls."""
    others = (limited, limited, measured, integrator != Integrator.EULER)
    return {
        name: choices[other]
        for (name, choices), other in zip(OTHER_STEPS.items(), others, strict=True)
    }


def _others(trial: Trial) -> dict[str, CompiledFunction]:
    measured = len(trial.sensors.output_matrix) > 0
    return other_steps(trial.limits.enforced, measured, trial.plant.integrator)


def _compiled_parts(
    policy: Policy, learner: Learner, trial: Trial, callers: list[CompiledFunction]
) -> Steps:
    """Compile what a trial needs; the callers are compiled by whoever calls this."""
    others, kinds = _others(trial), step_kinds(trial)
    compile_missing(names_of(policy, learner, [*trial.information, *others.values(), *callers]))
    for name, function in trial.information._asdict().items():
        compile_form(trial, name, function)
    for name, function in others.items():
        compiled_for(function, getattr(kinds, name).args)
    plan, learn = function_of(policy, kinds.plan), function_of(learner, kinds.learn)
    return Steps(plan, learn, **others)


def names_of(policy: Policy, learner: Learner, functions: list[CompiledFunction]) -> list[str]:
    """Return the names in the cache of what a trial needs of the package."""
    sources = (*map(path_of, functions), _source(policy), _source(learner))
    package = f"{__package__}."
    return [path for path in sources if isinstance(path, str) and path.startswith(package)]


def _source(part: Policy | Learner) -> str | Callable[..., None]:
    """Return the path of the function of a policy or a learner, or a custom function."""
    if isinstance(part, CompiledPolicy):
        return part.plan
    return part.learn if isinstance(part, CompiledLearner) else part.kernel_function


def compile_form(trial: Trial, name: str, function: CompiledFunction) -> None:
    """Compile a function of a form of M; ``name`` is its field in :class:`Information`."""
    kinds = _information_signatures(trial.plant, trial.network, trial.state)
    compiled_for(function, kinds[name].args)


def path_of(function: CompiledFunction) -> str:
    """Return the dotted path of a function of the package."""
    return f"{function.__module__}.{function.__name__}"


def _information_signatures(plant: Plant, network: Network, state: State) -> dict[str, NumbaType]:
    """Return the types of the functions of a form of M, by their names."""
    structs = (pointer_to(kind_of(part)) for part in (plant, network, state))
    given = (*structs, float64[::1])
    rows = types.void(*given)
    forms = float64[:, ::1](*given, float64[:, ::1], int64)
    return dict(zip(Information._fields, (rows, forms), strict=True))


def step_kinds(trial: Trial) -> Steps:
    """Return the types of the functions of a trial's steps."""
    whole, row = pointer_to(kind_of(trial)), float64[::1]
    writes, takes_time = types.void(whole, int64, row), types.void(whole, int64, float64)
    return Steps(
        plan=writes,
        learn=writes,
        limit_input=writes,
        note_error=writes,
        estimate_state=takes_time,
        observe=types.void(whole, int64, float64, row),
    )


def compiled_step(
    trial: Trial, step: CompiledFunction, points: Evaluation | None = None
) -> Callable[..., Any]:
    """Compile one of :data:`STEPS` or :data:`BETWEEN`, the loop, or an evaluation at points."""
    held = held_kind(trial)
    if step is hold:
        return compiled_for(step, tuple(held.field_dict.values()))
    first = (kind_of(points),) if step in (loop.advance, loop.evaluate_next) else ()
    return compiled_for(step, (held, *first, *_FURTHER_ARGUMENTS[step]))


_ROW, _MATRIX, _STACK = float64[::1], float64[:, ::1], float64[:, :, ::1]
_ARGUMENTS_BETWEEN: dict[CompiledFunction, tuple[NumbaType, ...]] = {
    loop.act_next: (int64,),
    loop.observe_next: (int64, float64, _ROW),
    loop.learn_next: (int64, _ROW),
    loop.write_accelerations: (_MATRIX, _MATRIX),
    loop.write_jacobian: (_MATRIX, _MATRIX),
    loop.write_jacobian_change: (_ROW, _MATRIX, _STACK),
    loop.write_following: (_ROW, _MATRIX, _MATRIX),
    loop.write_input_matrix: (_ROW, _MATRIX),
}
_FURTHER_ARGUMENTS = _ARGUMENTS_BETWEEN | {
    loop.plan_next: (int64,),
    loop.take_in_next: (int64, float64),
    loop.write_reached: (_ROW, _MATRIX, _ROW, _ROW),
    loop.advance: (int64, int64),
    loop.evaluate_next: (int64,),
}

BETWEEN = tuple(_ARGUMENTS_BETWEEN)
"""Functions that the interpreter calls where a plan or an update is written in numpy."""


def held_kind(trial: Trial) -> NumbaType:
    """Return the type of a trial that is held with pointers to its policy and learner."""
    steps = types.NamedTuple([*map(types.FunctionType, step_kinds(trial))], Steps)
    whole = (kind_of(trial), steps)
    return HeldTrialType(list(zip(FIELDS, whole, strict=True)))


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
    compiled_for(function, signature.args)
    return function


def _own(
    part: Policy | Learner, function: Callable[..., None], signature: NumbaType
) -> CompiledFunction:
    """Compile the function of a policy or a learner in a user's file."""
    if PLAIN:
        return cast(Callable[..., Any], function)
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
    """Return the type of an argument for numba; for a compiled function, of a pointer to it."""
    if not isinstance(value, tuple):
        return numba.typeof(value)
    layout = layout_of(value)
    if layout not in _kinds:
        _kinds[layout] = _kind_of_fields(value)
    return _kinds[layout]


_kinds: dict[Hashable, NumbaType] = {}


def _kind_of_fields(value: tuple[object, ...]) -> NumbaType:
    if isinstance(value, Plant):
        equations = (KNOWN, ACCELERATIONS, COMPLEX_ACCELERATIONS)
        kinds = [*map(types.FunctionType, equations), *map(kind_of, value[len(equations) :])]
    elif isinstance(value, Trial):
        functions = _information_signatures(value.plant, value.network, value.state)
        information = types.NamedTuple([*map(types.FunctionType, functions.values())], Information)
        kinds = [information if isinstance(part, Information) else kind_of(part) for part in value]
    else:
        kinds = [*map(kind_of, value)]
    return types.NamedTuple(kinds, type(value))


def compiled_for(function: CompiledFunction, kinds: tuple[NumbaType, ...]) -> Callable[..., Any]:
    """Return the machine code of a function for types of arguments; compiling it on first use."""
    if PLAIN:
        return cast(Callable[..., Any], function)
    if (function, kinds) not in _done:
        digest = hashlib.sha256(str(kinds).encode()).hexdigest()[:16]
        with one_compiler_at_a_time(f"{path_of(function)}-{digest}"):
            _done[function, kinds] = function.compile(kinds)
    return _done[function, kinds]


_done: dict[tuple[CompiledFunction, tuple[NumbaType, ...]], Callable[..., Any]] = {}
