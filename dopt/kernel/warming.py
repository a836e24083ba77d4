"""Compilation of the kernel's parts in two processes at once: ``python -m dopt.kernel.warming``.

Each part is compiled by itself and called through a pointer, so that any process can put it into
the cache. Reading it there is a matter of seconds.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from dopt.kernel.cache import completed
from dopt.kernel.equations import compiled_equations
from dopt.kernel.information import absent, dual, fresh, primal_linear, primal_network, sketch
from dopt.kernel.pointers import compile_information, compiled_at, compiled_loop, signatures
from dopt.kernel.run import KernelTrial
from dopt.kernel.structs import Information
from dopt.learning import LEARNERS, Adam
from dopt.policies import POLICIES, DOptimal
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS

ENDS = ("first", "last")
"""Ends of the list of parts, at which the two processes begin."""

SECONDS_BETWEEN_MESSAGES = 5.0

_log = logging.getLogger("dopt.kernel")


def compile_in_two_processes(everything: bool) -> None:
    """Fill the cache; what a process could not compile is left to whoever needs it.

    With ``everything``, all policies, learners and forms of M of the package are compiled.
    """
    if len(os.sched_getaffinity(0)) < len(ENDS):
        return
    start, total = time.perf_counter(), choices(everything).n_parts()
    running = [_started(end, *(["everything"] if everything else [])) for end in ENDS]
    said = -SECONDS_BETWEEN_MESSAGES
    try:
        while any(process.poll() is None for process in running):
            seconds = time.perf_counter() - start
            if seconds - said >= SECONDS_BETWEEN_MESSAGES:
                said = seconds
                _log.warning(
                    "compiling the kernel, once per machine: %d of %d parts, %.0f s",
                    *(min(completed(), total), total, seconds),
                )
            time.sleep(0.1)
    finally:
        for process in running:
            process.kill()  # where the wait was broken off; one that has ended stays as it is
            process.wait()


def _started(*words: str) -> subprocess.Popen[bytes]:
    place = str(Path(__file__).resolve().parents[2])
    paths = os.pathsep.join(filter(None, (place, os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", __spec__.name, *words],  # no module of the working folder
        env=os.environ | {"PYTHONPATH": paths},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def compile_parts(end: str, everything: bool) -> None:
    """Compile the parts of the kernel, beginning at one end of their list.

    The two processes meet: what the other has compiled is only loaded.
    """
    parts = kernel_parts(everything)
    for part in parts if end == "first" else reversed(parts):
        part()


class Choices(NamedTuple):
    """Paths of the functions of policies and learners, and modules of forms of M, to compile."""

    plans: list[str]
    learns: list[str]
    forms: list[ModuleType]

    def n_parts(self) -> int:
        """Return how many parts they are, with the loop and the equations of every system."""
        functions = {one for form in self.forms for one in (form.add_rows, form.planning_forms)}
        return 1 + len(SYSTEMS) + len(self.plans) + len(self.learns) + len(functions)


def choices(everything: bool) -> Choices:
    """Return what a trial of the paper needs, or all that the package holds."""
    if not everything:
        return Choices([DOptimal.kernel_function], [Adam.kernel_function], [primal_network])
    return Choices(
        sorted({policy.kernel_function for policy in POLICIES.values() if policy.compiled}),
        sorted({learner.kernel_function for learner in LEARNERS.values() if learner.compiled}),
        [absent, primal_network, primal_linear, dual, sketch, fresh],
    )


def kernel_parts(everything: bool) -> list[Callable[[], object]]:
    """Return what compiles each part."""
    spec = TrialSpec.from_names({"name": "pendulum", "grid_points": [2, 2]}, "d_optimal")
    trial, chosen = KernelTrial(spec), choices(everything)
    plan, learn = signatures(trial.trial)
    forms = [Information(module.add_rows, module.planning_forms) for module in chosen.forms]
    return [
        partial(compiled_loop, trial.trial, trial.constants[3]),
        *(partial(compiled_at, path, learn) for path in chosen.learns),
        *(partial(compiled_equations, system()) for system in SYSTEMS.values()),
        *(partial(compile_information, trial.trial, form) for form in forms),
        *(partial(compiled_at, path, plan) for path in chosen.plans),
    ]


if __name__ == "__main__":
    compile_parts(sys.argv[1], everything="everything" in sys.argv)
