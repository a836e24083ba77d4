"""Compilation of missing parts of the kernel in other processes.

Each part is compiled by itself and called through a pointer, so that any process can put it into
the cache, from which the others load it in seconds. The process that needs a part loads it, too:
in the process that compiles a part the linker may take a function that it calls from an earlier
compilation, which can round differently.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from dopt.cores import usable_cores
from dopt.kernel.cache import CACHE_FOLDER, CACHE_VARIABLE, complete_names

ENDS = ("first", "last")
"""Ends of the list of parts, at which the two processes begin."""

SECONDS_BETWEEN_MESSAGES = 5.0

_PROGRAM = "dopt.kernel.warming"

_log = logging.getLogger("dopt.kernel")


def compile_missing(names: Sequence[str]) -> None:
    """Compile the parts that the cache does not hold, in one process on each of two cores.

    What they could not compile is left to the process that needs it.

    Parameters
    ----------
    names : sequence of str
        Names of parts of the package: those of :func:`dopt.kernel.warming.kernel_parts`.
    """
    there = complete_names()
    missing = [name for name in names if name not in there]
    if not missing:
        return
    start = time.perf_counter()
    running = [_started(end, missing) for end in ENDS[: usable_cores()]]
    said = -SECONDS_BETWEEN_MESSAGES
    try:
        while any(process.poll() is None for process in running):
            seconds = time.perf_counter() - start
            if seconds - said >= SECONDS_BETWEEN_MESSAGES:
                said = seconds
                _log.warning(
                    "compiling the kernel, once per machine: %d of %d parts, %.0f s",
                    *(len(complete_names() & {*missing}), len(missing), seconds),
                )
            time.sleep(0.1)
    finally:
        for process in running:
            process.kill()  # where the wait was broken off; one that has ended stays as it is
            process.wait()


def _started(end: str, names: Sequence[str]) -> subprocess.Popen[bytes]:
    place = str(Path(__file__).resolve().parents[2])
    paths = os.pathsep.join(filter(None, (place, os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", _PROGRAM, end, *names],  # no module of the working folder
        env=os.environ | {"PYTHONPATH": paths, CACHE_VARIABLE: str(CACHE_FOLDER.parents[1])},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
