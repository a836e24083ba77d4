"""The parts of the kernel, compiled into the cache: ``python -m dopt.kernel.warming END NAME...``.

END says at which end of the list the process begins: first or last.

Numba optimizes each function that it compiles, and makes machine code of it, also where only other
compiled functions call it, whose code holds it already and is optimized as a whole. A process that
calls nothing that it compiles can do without: the parts that the paper's trials need then compile
in 48 CPU seconds, otherwise in 72 (Intel Xeon, Numba 0.68.1), and their numbers are the same, up to
the rounding of sums that may be taken in any order. For this, private methods of Numba's compiler
are replaced in this process alone; ``pyproject.toml`` bounds the versions of Numba by what was
tested.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Container, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numba import _dynfunc
from numba.core.codegen import CPUCodeLibrary
from numba.core.cpu import CPUContext
from numba.core.targetconfig import ConfigStack

from dopt.algorithm import Integrator
from dopt.fields import IN_NUMPY
from dopt.kernel import cache
from dopt.kernel.equations import compiled_equations, name_of_equations
from dopt.kernel.from_spec import information_of
from dopt.kernel.gaussian_process import negative_evidence, refactor, thin
from dopt.kernel.held import hold
from dopt.kernel.information import ABSENT, FORMS, PRIMAL
from dopt.kernel.loop import advance, evaluate_next
from dopt.kernel.pointers import (
    BETWEEN,
    OTHER_STEPS,
    STEPS,
    compile_form,
    compiled_at,
    compiled_for,
    compiled_step,
    kind_of,
    names_of,
    other_steps,
    path_of,
    step_kinds,
)
from dopt.kernel.run import KernelTrial, NumpyParts, is_stepped
from dopt.kernel.structs import Information
from dopt.learning import LEARNERS, Adam, RecursiveLeastSquares
from dopt.policies import POLICIES, DOptimal, Periodic, Uniform
from dopt.process import collect_rarely
from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from dopt.types import CompiledFunction

_optimize = CPUCodeLibrary._optimize_final_module
_finish = CPUCodeLibrary._finalize_final_module
_executable = CPUContext.get_executable


def leave_callees_out() -> None:
    """Skip separate optimisation of functions compiled only as callees.

    There is no machine code of it either: Python must not call such a function in this process.
    """
    CPUCodeLibrary._optimize_final_module = _optimize_outermost
    CPUCodeLibrary._finalize_final_module = _finish_outermost
    CPUContext.get_executable = _executable_of_outermost


def _is_callee() -> bool:
    """Return True if the compilation of another function asked for the present one."""
    return len(ConfigStack()) > 1


def _optimize_outermost(library: Any) -> None:
    """Optimize a library; not a callee's, which is optimized as part of its callers."""
    if not _is_callee():
        _optimize(library)


def _finish_outermost(library: Any) -> None:
    """Hand a library to the compiler's back end; a callee's is only linked into its callers'."""
    if not _is_callee():
        _finish(library)
        return
    library._finalize_dynamic_globals()
    library._verify_declare_only_symbols()
    library._finalized = True


def _executable_of_outermost(context: Any, library: Any, described: Any, env: Any) -> Any:
    """Return what Python calls; of a callee an object without code by which Numba knows it."""
    if not _is_callee():
        return _executable(context, library, described, env)
    library._ensure_finalized()
    name, nowhere = described.qualname.rpartition(".")[-1], 0
    module = described.lookup_module()
    return _dynfunc.make_function(module, name, "", nowhere, env, (library,))


class Choices(NamedTuple):
    """Paths of the functions of policies and learners, and forms of M, to compile."""

    plans: list[str]
    learns: list[str]
    forms: Sequence[Information]


def choices(everything: bool) -> Choices:
    """Return what a trial of the paper needs, or all that the package holds."""
    if not everything:
        return Choices(
            [policy.kernel_function for policy in (DOptimal, Uniform, Periodic)],
            [learner.kernel_function for learner in (Adam, RecursiveLeastSquares)],
            (PRIMAL, ABSENT),
        )
    plans = {policy.kernel_function for policy in POLICIES.values() if policy.compiled}
    learns = {learner.kernel_function for learner in LEARNERS.values() if learner.compiled}
    return Choices(sorted(plans - {IN_NUMPY}), sorted(learns - {IN_NUMPY}), FORMS)


def kernel_parts(everything: bool) -> dict[str, Callable[[], object]]:
    """Return what compiles each part, by its name in the cache."""
    spec = TrialSpec.from_names({"name": "pendulum", "grid_points": [2, 2]}, "d_optimal")
    trial, chosen = KernelTrial(spec), choices(everything)
    kinds = step_kinds(trial.trial)
    others = {
        function: getattr(kinds, name)
        for name, choices in OTHER_STEPS.items()
        for function in choices[: 2 if everything else 1]
    }
    systems = [system() for system in SYSTEMS.values()]
    forms = [pair for form in chosen.forms for pair in form._asdict().items()]
    steps = (advance, evaluate_next, *STEPS, *BETWEEN) if everything else (advance, hold)
    process = trial.trial.network, trial.trial.state.theta, trial.trial.state.posterior
    row = process[1]
    fits: dict[CompiledFunction, tuple[object, ...]] = {
        thin: process,
        refactor: process,
        negative_evidence: (row, np.zeros((1, 1)), row, row, row),
    }
    return {
        **{path_of(one): partial(compiled_step, trial.trial, one, trial.points) for one in steps},
        **{path_of(one): partial(compiled_for, one, kind.args) for one, kind in others.items()},
        **{path: partial(compiled_at, path, kinds.learn) for path in chosen.learns},
        **{name_of_equations(system): partial(compiled_equations, system) for system in systems},
        **{path_of(form): partial(compile_form, trial.trial, name, form) for name, form in forms},
        **{path: partial(compiled_at, path, kinds.plan) for path in chosen.plans},
        **{
            path_of(fit): partial(compiled_for, fit, tuple(map(kind_of, given)))
            for fit, given in fits.items()
            if everything
        },
    }


def needed_parts(configs: Iterable[TrialConfig]) -> list[str]:
    """Return the names in the cache of what the trials of configurations call of the package."""
    shipped = {name_of_equations(system()) for system in SYSTEMS.values()}
    found: dict[str, None] = {}
    for config in configs:
        callers: list[CompiledFunction] = [hold, advance]
        if is_stepped(config):
            callers = [*STEPS, evaluate_next, *(BETWEEN if NumpyParts.needed_by(config) else ())]
        system, limited = config.system, config.limits is not None and config.limits.enforced
        integrator = Integrator[system.integrator.upper()]
        others = other_steps(limited, len(system.output_rows) > 0, integrator)
        functions = [*callers, *others.values(), *information_of(config)]
        found |= dict.fromkeys(names_of(config.policy, config.learner, functions))
        if (name := name_of_equations(config.system)) in shipped:
            found[name] = None
    return [*found]


def compile_parts(end: str, names: Container[str]) -> None:
    """Compile the parts of the kernel with these names, beginning at one end of their list.

    Two processes meet: what the other has compiled is only loaded. Where the cache takes no more
    they end, since nobody would find what they compile.
    """
    folder = cache.CACHE_FOLDER
    parts = [part for name, part in kernel_parts(everything=True).items() if name in names]
    for part in parts if end == "first" else reversed(parts):
        part()
        if folder != cache.CACHE_FOLDER or not cache.can_be_filled():
            return


if __name__ == "__main__":
    collect_rarely()
    leave_callees_out()
    compile_parts(sys.argv[1], sys.argv[2:])
