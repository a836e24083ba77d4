"""Interface of executors: chunks of tasks are submitted, outcomes are returned as tasks end.

An executor knows neither the database nor Hydra. It never repeats a task: it reports lost tasks,
and the scheduler decides whether they run again.
"""

from __future__ import annotations

import os
import resource
import socket
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Self

from dopt.errors import UnusableEnvironmentError
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.executors.limits import NO_LIMITS, Limits, TrialTimeoutError, interrupted_after
from orchestrate.records import ENVIRONMENT, Failure, RunRecord

Run = Callable[[TrialSpec], TrialResult]
"""Function that runs a trial: pure, and importable by name where it goes to other processes."""

Prepare = Callable[[], None]
"""Function that is called once in a process before its first trial."""


@dataclass(frozen=True)
class Task:
    """Trial to run, with its key, and the factor on the memory that its process may take."""

    key: str
    spec: TrialSpec
    memory_factor: float = 1.0


@dataclass(frozen=True)
class TaskDone:
    """Finished task: its result, or the exception that it raised."""

    key: str
    run: RunRecord
    outcome: TrialResult | Failure


@dataclass(frozen=True)
class WorkerLost:
    """Unfinished tasks of a worker that died.

    Attributes
    ----------
    keys
        Tasks of the chunk without an outcome; one of them may have caused the death.
    reason
        Description of the death, such as "killed by signal 9".
    cause
        "killed", "out of memory", or "timeout" if the only task of ``keys`` exceeded its time
        limit.
    traceback
        Stack of the worker when it died; empty if unknown.
    node_lost
        Whether the whole node was lost, so that no task caused it.
    node, pid
        Host name and process number of the worker, if known.
    """

    keys: tuple[str, ...]
    reason: str
    node_lost: bool = False
    cause: str = "killed"
    traceback: str = ""
    node: str = "unknown"
    pid: int = 0


Event = TaskDone | WorkerLost


class Executor(ABC):
    """Context manager that starts and stops workers, which run chunks of tasks.

    Attributes
    ----------
    slots : int
        Number of tasks that run at the same time; known once started.
    batch : int or None
        Chunk size in trials of one configuration, for executors that run a chunk as one batch.
    """

    slots: int = 1
    batch: int | None = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @abstractmethod
    def start(self) -> None:
        """Start the workers.

        Raises
        ------
        InfrastructureError
            If they cannot be started.
        """

    @abstractmethod
    def submit(self, chunk: Sequence[Task]) -> None:
        """Queue a chunk, whose tasks run in order on one worker; return at once."""

    @abstractmethod
    def wait(self, timeout: float) -> list[Event]:
        """Return the events since the last call, after at most about ``timeout`` seconds.

        Raises
        ------
        InfrastructureError
            If the connection to the workers is lost.
        """

    @property
    @abstractmethod
    def pending(self) -> int:
        """Number of submitted chunks that have not finished."""

    @abstractmethod
    def stop(self) -> None:
        """Kill the workers at once."""


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
    run_record = record_of(started, time.perf_counter() - wall, time.process_time() - cpu)
    return TaskDone(task.key, run_record, outcome)


def record_of(started: datetime, wall_seconds: float, cpu_seconds: float) -> RunRecord:
    """Return the record of a run in this process, which ends now."""
    return RunRecord(
        node=socket.gethostname(),
        pid=os.getpid(),
        wall_seconds=wall_seconds,
        cpu_seconds=cpu_seconds,
        peak_memory_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * BYTES_PER_KIB,
        started=started,
        ended=datetime.now(UTC),
    )


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
