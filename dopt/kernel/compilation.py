"""Compilation of missing parts of the kernel in other processes.

Each part is compiled by itself and called through a pointer, so that any process can put it into
the cache, from which the others load it in seconds. The process that needs a part loads it, too:
in the process that compiles a part the linker may take a function that it calls from an earlier
compilation, which can round differently.
"""

from __future__ import annotations

import fcntl
import logging
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from dopt.kernel import cache
from dopt.kernel.plain import PLAIN
from dopt.process import usable_cores

ENDS = ("first", "last")
"""Ends of the list of parts, at which the two processes begin."""

SECONDS_BETWEEN_MESSAGES = {True: 1.0, False: 30.0}
"""On a terminal, where each message takes the place of the one before, and elsewhere."""

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
    needed = [] if PLAIN else cache.missing(names)
    if not needed or not cache.can_be_filled():
        return
    start, next_message, spoke, over = time.perf_counter(), 0.0, False, False
    running = [_started(end, needed) for end in ENDS[: usable_cores()]]
    try:
        while not over:
            over = all(process.poll() is not None for process in running)
            seconds = time.perf_counter() - start
            if spoke if over else seconds >= next_message:
                next_message = seconds + SECONDS_BETWEEN_MESSAGES[_on_terminal()]
                there = len(needed) - len(cache.missing(needed))
                state = f"{there} of {len(needed)} parts, {seconds:.0f} s"
                spoke = _said(f"compiling the kernel, {cache.for_whom()}: {state}", last=over)
            time.sleep(0.0 if over else 0.1)
    finally:
        for process in running:
            process.kill()  # where the wait was broken off; one that has ended stays as it is
            process.wait()


def _said(text: str, *, last: bool) -> bool:
    """Say it, unless another process does on the same standard error, as workers of a launch."""
    try:
        fcntl.lockf(sys.stderr, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if last:
            fcntl.lockf(sys.stderr, fcntl.LOCK_UN)
    except BlockingIOError:
        return False
    except (OSError, TypeError, ValueError):  # no file, as in a notebook
        pass
    if _on_terminal():
        sys.stderr.write(f"{text}\x1b[K{chr(10) if last else chr(13)}")
        sys.stderr.flush()
    else:
        _log.warning(text)
    return True


def _on_terminal() -> bool:
    """Return whether messages go to a terminal, and to no handler of the program."""
    return not _log.hasHandlers() and sys.stderr is not None and sys.stderr.isatty()


def _started(end: str, names: Sequence[str]) -> subprocess.Popen[bytes]:
    place = str(Path(__file__).resolve().parents[2])
    paths = os.pathsep.join(filter(None, (place, os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", _PROGRAM, end, *names],  # no module of the working folder
        env=os.environ
        | {"PYTHONPATH": paths, cache.CACHE_VARIABLE: str(cache.CACHE_FOLDER.parents[1])},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
