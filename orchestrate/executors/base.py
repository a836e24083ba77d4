"""Interface of executors, the registry that names them, and the one in this process.

Chunks of tasks are submitted, and outcomes are returned as tasks end. A new executor is a module
with a ``FACTORY``, its file ``conf/executor/NAME.yaml``, and its name in :data:`EXECUTORS`.

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
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import import_module
from typing import Self

from dopt.errors import UnusableEnvironmentError, unknown_name
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.config import LaunchSettings
from orchestrate.errors import LaunchError
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


EXECUTORS: Mapping[str, str] = {
    "inprocess": __name__,
    **{name: f"orchestrate.executors.{name}" for name in ("local", "lockstep", "ray")},
}
"""Module of each executor in ``conf/executor/``, imported when a launch names it."""


@dataclass(frozen=True)
class ExecutorFactory:
    """Constructor of an executor, and the facts that a launch needs before it starts one.

    Attributes
    ----------
    make
        Returns the executor for the settings, not yet started. The last argument has been called
        on this machine; machines of a cluster call it before their first trial.
    trials_at_once
        Number of trials that hold memory of this machine at the same time; None where they use
        other memory.
    check
        Raises ``LaunchError`` for settings that cannot work here, before any trial is registered.
    path
        Execution path of the trials, "kernel" or "reference".
    in_process
        Whether trials run in the process of the launch; a single trial then uses this executor.
    options
        Settings of the section ``executor``, beside its name; None where it takes any.
    limiting_key
        Key that reduces ``trials_at_once``.
    """

    make: Callable[[LaunchSettings, Run, Prepare | None], Executor]
    trials_at_once: Callable[[LaunchSettings], int | None]
    check: Callable[[LaunchSettings], None] = lambda _: None
    path: str = "kernel"
    in_process: bool = False
    options: tuple[str, ...] | None = None
    limiting_key: str = "launch.workers"


MOST_PROCESSES = 1000
"""Processes on one machine above which a number is a mistake."""


def check_processes(settings: LaunchSettings) -> None:
    """Raise ``LaunchError`` if more processes are asked for than a machine can start."""
    if settings.workers and settings.workers > MOST_PROCESSES:
        raise LaunchError(
            f"{settings.workers:,} processes are asked for, but at most {MOST_PROCESSES:,} on one "
            "machine are expected: set launch.workers (of work: --processes) lower."
        )


def limits_of(settings: LaunchSettings) -> Limits:
    """Return the limits of one trial."""
    return Limits(settings.timeout, settings.memory_gib)


def executor_factory(settings: LaunchSettings) -> ExecutorFactory:
    """Return the factory of the executor that the settings name.

    Raises
    ------
    SpecificationError
        For an unknown name of an executor or a setting, with the nearest valid one.
    """
    if settings.executor not in EXECUTORS:
        raise unknown_name("executor.name", settings.executor, EXECUTORS)
    factory: ExecutorFactory = import_module(EXECUTORS[settings.executor]).FACTORY
    for name in settings.executor_options:
        if factory.options is not None and name not in factory.options:
            raise unknown_name("setting of executor", name, [*factory.options, "name"])
    return factory


def make_executor(settings: LaunchSettings, run: Run, prepare: Prepare | None = None) -> Executor:
    """Return the executor that the settings name, not yet started."""
    return executor_factory(settings).make(settings, run, prepare)


class QueueExecutor(Executor):
    """Queue of chunks that run in this process, in calls of ``wait``."""

    def __init__(self) -> None:
        self._chunks: deque[deque[Task]] = deque()

    def start(self) -> None:
        self.slots = 1

    def submit(self, chunk: Sequence[Task]) -> None:
        if chunk:
            self._chunks.append(deque(chunk))

    @property
    def pending(self) -> int:
        return len(self._chunks)

    def stop(self) -> None:
        self._chunks.clear()


class InProcessExecutor(QueueExecutor):
    """Runs one task at each call of ``wait``.

    A time limit cannot stop native code that does not return to the interpreter. The memory limit
    is not set, because it would hold for the whole launch.
    """

    def __init__(self, run: Run, limits: Limits = NO_LIMITS) -> None:
        super().__init__()
        self._run = run
        self._limits = limits

    def wait(self, timeout: float) -> list[Event]:  # noqa: ARG002  # a running trial is not left
        if not self._chunks:
            return []
        event = run_task(self._run, self._chunks[0].popleft(), self._limits)
        if not self._chunks[0]:
            self._chunks.popleft()
        return [event]


FACTORY = ExecutorFactory(
    make=lambda settings, run, _: InProcessExecutor(run, limits_of(settings)),
    trials_at_once=lambda _: 1,
    in_process=True,
    options=(),
)
