"""Compilation of the kernel's parts in two processes at once: ``python -m dopt.kernel.warming``.

Each part is compiled by itself and called through a pointer, so that any process can put it into
the cache. Reading it there is a matter of seconds.
"""

from __future__ import annotations

import functools
import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from dopt.kernel.cache import completed
from dopt.kernel.equations import compiled_equations
from dopt.kernel.pointers import compile_information, compiled_loop, function_of, signatures
from dopt.kernel.run import KernelTrial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS

ENDS = ("first", "last")
"""Ends of the list of parts, at which the two processes begin."""

SECONDS_BETWEEN_MESSAGES = 5.0

_log = logging.getLogger("dopt.kernel")


def compile_in_two_processes() -> None:
    """Fill the cache; what a process could not compile is left to whoever needs it."""
    if len(os.sched_getaffinity(0)) < len(ENDS):
        return
    start, total = time.perf_counter(), len(SYSTEMS) + 5
    running = [_started(end) for end in ENDS]
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


def _started(end: str) -> subprocess.Popen[bytes]:
    place = str(Path(__file__).resolve().parents[2])
    paths = os.pathsep.join(filter(None, (place, os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", __spec__.name, end],  # no module of the working folder
        env=os.environ | {"PYTHONPATH": paths},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def compile_parts(end: str) -> None:
    """Compile the parts of the kernel that a trial of the paper needs, beginning at one end.

    The two processes meet: what the other has compiled is only loaded.
    """
    spec = TrialSpec.from_names({"name": "pendulum", "grid_points": [2, 2]}, "d_optimal")
    trial = KernelTrial(spec)
    plan, learn = signatures(trial.trial)
    parts: list[Callable[[], object]] = [
        lambda: compiled_loop(trial.trial, trial.constants[3]),
        lambda: function_of(spec.learner, learn),
        *(functools.partial(compiled_equations, system()) for system in SYSTEMS.values()),
        lambda: function_of(spec.policy, plan),
        lambda: compile_information(trial.trial),
    ]
    for part in parts if end == "first" else reversed(parts):
        part()


if __name__ == "__main__":
    compile_parts(sys.argv[1])
