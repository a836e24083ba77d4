"""Run one task and measure it; the same code on every executor."""

from __future__ import annotations

import os
import resource
import socket
import time
import traceback
from datetime import UTC, datetime

from dopt.result import TrialResult
from orchestrate.executors.base import Finished, Run, Task, Trouble, Usage
from orchestrate.executors.limits import NO_LIMITS, Limits, TrialTimeoutError, interrupted_after

KIBIBYTE = 1024


def run_task(run: Run, task: Task, limits: Limits = NO_LIMITS) -> Finished:
    """Return the result of the task, or the exception that it raised, at the latest at its limit.

    A limit of time needs the main thread of the process.
    """
    started, wall, cpu = datetime.now(UTC), time.perf_counter(), time.process_time()
    outcome: TrialResult | Trouble
    try:
        with interrupted_after(limits):
            outcome = _checked(run(task.spec))
    except (Exception, SystemExit, TrialTimeoutError) as error:
        outcome = trouble(error)
    usage = Usage(
        node=socket.gethostname(),
        pid=os.getpid(),
        wall_seconds=time.perf_counter() - wall,
        cpu_seconds=time.process_time() - cpu,
        peak_memory_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * KIBIBYTE,
        started=started,
        ended=datetime.now(UTC),
    )
    return Finished(task.key, usage, outcome)


def trouble(error: BaseException) -> Trouble:
    """Return what is kept of an exception."""
    # What was lost for want of memory is held by the frames; the text does not need it.
    traceback.clear_frames(error.__traceback__)
    text = "".join(traceback.format_exception(error))
    return Trouble(type(error).__name__, str(error), text, _cause(error))


def _cause(error: BaseException) -> str:
    if isinstance(error, TrialTimeoutError):
        return "timeout"
    # torch has an error of this name for a graphics processor, which is no MemoryError.
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return "out of memory"
    return "malformed" if isinstance(error, _NoResultError) else "exception"


class _NoResultError(TypeError):
    """What a trial returned is no result at all."""


def _checked(result: object) -> TrialResult:
    if isinstance(result, TrialResult):
        return result
    raise _NoResultError(
        f"The trial returned {type(result).__name__}, but a TrialResult is expected: correct what "
        "ran it."
    )
