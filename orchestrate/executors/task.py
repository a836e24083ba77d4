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

KIBIBYTE = 1024


def run_task(run: Run, task: Task) -> Finished:
    """Return the result of the task, or the exception that it raised."""
    started, wall, cpu = datetime.now(UTC), time.perf_counter(), time.process_time()
    outcome: TrialResult | Trouble
    try:
        outcome = run(task.spec)
    except Exception as error:
        text = "".join(traceback.format_exception(error))
        outcome = Trouble(type(error).__name__, str(error), text)
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
