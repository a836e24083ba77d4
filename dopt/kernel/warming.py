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
from pathlib import Path

from dopt.kernel.cache import completed
from dopt.kernel.equations import compiled_equations
from dopt.kernel.pointers import compiled_loop, function_of, signatures
from dopt.kernel.run import KernelTrial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS

SHARES = (("loop",), ("policy", "learner", "equations"))
"""Parts that each process compiles; together they take about as long."""

SECONDS_BETWEEN_MESSAGES = 5.0

_log = logging.getLogger("dopt.kernel")


def compile_in_two_processes() -> None:
    """Fill the cache; what a process could not compile is left to whoever needs it."""
    if len(os.sched_getaffinity(0)) < len(SHARES):
        return
    start, total = time.perf_counter(), len(SYSTEMS) + 3
    running = [_started(share) for share in SHARES]
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


def _started(share: tuple[str, ...]) -> subprocess.Popen[bytes]:
    place = str(Path(__file__).resolve().parents[2])
    paths = os.pathsep.join(filter(None, (place, os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", __spec__.name, *share],  # no module of the working folder
        env=os.environ | {"PYTHONPATH": paths},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def compile_share(share: list[str]) -> None:
    """Compile parts of the kernel as a trial of the paper needs them."""
    spec = TrialSpec.from_names({"name": "pendulum", "grid_points": [2, 2]}, "d_optimal")
    trial = KernelTrial(spec)
    plan, learn = signatures(trial.trial)
    if "policy" in share:
        function_of(spec.policy, plan)
    if "loop" in share:
        compiled_loop(trial.trial, trial.constants[3])
    if "learner" in share:
        function_of(spec.learner, learn)
    if "equations" in share:
        for system in SYSTEMS.values():
            compiled_equations(system())


if __name__ == "__main__":
    compile_share(sys.argv[1:])
