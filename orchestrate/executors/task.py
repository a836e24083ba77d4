"""Execution of one task with its time and memory; the same code on every executor."""

from __future__ import annotations

import os
import resource
import socket
import time
import traceback
from datetime import UTC, datetime

from dopt.errors import UnusableEnvironmentError
from dopt.result import TrialResult
from orchestrate.executors.base import Run, Task, TaskDone
from orchestrate.executors.limits import NO_LIMITS, Limits, TrialTimeoutError, interrupted_after
from orchestrate.records import ENVIRONMENT, Failure, RunRecord

BYTES_PER_KIB = 1024


def run_task(run: Run, task: Task, limits: Limits = NO_LIMITS) -> TaskDone:
    """Run the task within its time limit; return its result or the exception that it raised.

    A time limit needs the main thread of the process.
    """
    started, wall, cpu = datetime.now(UTC), time.perf_counter(), time.process_time()
    outcome: TrialResult | Failure
    try:
        with interrupted_after(limits):
            outcome = _checked(run(task.spec))
    except (Exception, SystemExit, TrialTimeoutError) as error:
        outcome = failure_of(error)
    run_record = RunRecord(
        node=socket.gethostname(),
        pid=os.getpid(),
        wall_seconds=time.perf_counter() - wall,
        cpu_seconds=time.process_time() - cpu,
        peak_memory_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * BYTES_PER_KIB,
        started=started,
        ended=datetime.now(UTC),
    )
    return TaskDone(task.key, run_record, outcome)


def failure_of(error: BaseException) -> Failure:
    """Return the record of an exception."""
    # The frames may hold the memory that was lacking; the text does not need them.
    traceback.clear_frames(error.__traceback__)
    text = "".join(traceback.format_exception(error))
    return Failure(type(error).__name__, str(error), text, _cause(error))


def _cause(error: BaseException) -> str:
    if isinstance(error, TrialTimeoutError):
        return "timeout"
    # torch.OutOfMemoryError, raised for a GPU, is not a MemoryError.
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return "out of memory"
    if isinstance(error, UnusableEnvironmentError):
        return ENVIRONMENT
    return "malformed" if isinstance(error, _NoResultError) else "exception"


class _NoResultError(TypeError):
    """Return value of a trial that is not a TrialResult."""


def _checked(result: object) -> TrialResult:
    if isinstance(result, TrialResult):
        return result
    raise _NoResultError(
        f"The trial returned {type(result).__name__}, but a TrialResult is expected: correct the "
        "function that ran it."
    )
