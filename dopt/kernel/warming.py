"""The parts of the kernel, compiled into the cache: ``python -m dopt.kernel.warming END NAME...``.

END says at which end of the list the process begins: first or last.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Container, Sequence
from functools import partial
from typing import NamedTuple

from dopt.kernel import cache, loop
from dopt.kernel.equations import compiled_equations, name_of_equations
from dopt.kernel.information import FORMS, NETWORK
from dopt.kernel.loop import advance, evaluate_next
from dopt.kernel.outermost_code import leave_callees_out
from dopt.kernel.pointers import (
    BETWEEN,
    OTHER_STEPS,
    STEPS,
    compile_form,
    compiled_at,
    compiled_evaluation,
    compiled_loop,
    compiled_step,
    path_of,
    step_kinds,
)
from dopt.kernel.run import KernelTrial
from dopt.kernel.structs import Information
from dopt.learning import LEARNERS, Adam
from dopt.policies import POLICIES, DOptimal
from dopt.process import collect_rarely
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS


class Choices(NamedTuple):
    """Paths of the functions of policies and learners, and forms of M, to compile."""

    plans: list[str]
    learns: list[str]
    forms: Sequence[Information]


def choices(everything: bool) -> Choices:
    """Return what a trial of the paper needs, or all that the package holds."""
    if not everything:
        return Choices([DOptimal.kernel_function], [Adam.kernel_function], [NETWORK])
    plans = {policy.kernel_function for policy in POLICIES.values() if policy.compiled}
    learns = {learner.kernel_function for learner in LEARNERS.values() if learner.compiled}
    return Choices(
        sorted(plans | {path_of(loop.plan_in_numpy)}),
        sorted(learns | {path_of(loop.learn_in_numpy)}),
        FORMS,
    )


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
    steps, whole = (*STEPS, *BETWEEN) if everything else STEPS[:1], (trial.trial, trial.points)
    evaluation = {path_of(evaluate_next): partial(compiled_evaluation, *whole)}
    return {
        path_of(advance): partial(compiled_loop, *whole),
        **(evaluation if everything else {}),
        **{path_of(step): partial(compiled_step, trial.trial, step) for step in steps},
        **{path_of(one): partial(compiled_at, path_of(one), others[one]) for one in others},
        **{path: partial(compiled_at, path, kinds.learn) for path in chosen.learns},
        **{name_of_equations(system): partial(compiled_equations, system) for system in systems},
        **{path_of(form): partial(compile_form, trial.trial, name, form) for name, form in forms},
        **{path: partial(compiled_at, path, kinds.plan) for path in chosen.plans},
    }


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
