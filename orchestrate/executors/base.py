"""The one interface behind which trials run: tasks go in as chunks, outcomes come out as they end.

An executor knows neither the database nor Hydra. It never runs a task twice by itself: what is
lost is reported, and the driver decides.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Self

from dopt.result import TrialResult
from dopt.spec import TrialSpec

Run = Callable[[TrialSpec], TrialResult]
"""What is done with a trial: pure, and importable by name where it goes to other processes."""


@dataclass(frozen=True)
class Task:
    """One trial to run, with its key."""

    key: str
    spec: TrialSpec


@dataclass(frozen=True)
class Usage:
    """Where and when a task ran, and what it used."""

    node: str
    pid: int
    wall_seconds: float
    cpu_seconds: float
    peak_memory_bytes: int
    started: datetime
    ended: datetime


@dataclass(frozen=True)
class Trouble:
    """An exception that a task raised.

    ``cause`` is its kind: "exception", "timeout", "out of memory" or "malformed".
    """

    type: str
    message: str
    traceback: str
    cause: str = "exception"


@dataclass(frozen=True)
class Finished:
    """A task that ran to its end: a result, or the exception that it raised."""

    key: str
    usage: Usage
    outcome: TrialResult | Trouble


@dataclass(frozen=True)
class Lost:
    """Tasks whose worker ended before they did.

    Attributes
    ----------
    keys
        The tasks of the chunk without an outcome; one of them may be to blame.
    reason
        What is known of the end, such as "been killed by signal 9".
    cause
        Its kind: "killed", "out of memory", or "timeout" where the one task of ``keys`` did not
        heed its limit of time.
    traceback
        Where the worker was, as far as it could still say so.
    blameless
        Whether the whole node was lost, for which no task is to blame.
    node, pid
        Where the worker ran, as far as it is known.
    """

    keys: tuple[str, ...]
    reason: str
    blameless: bool = False
    cause: str = "killed"
    traceback: str = ""
    node: str = "unknown"
    pid: int = 0


Event = Finished | Lost


class Executor(ABC):
    """Runs chunks of tasks on one or more workers; a context manager that starts and ends them.

    Attributes
    ----------
    slots : int
        Number of tasks that run at the same time; known once started.
    batch : int or None
        Trials of one configuration that make a chunk, where they run together.
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
        """Bring the workers up.

        Raises
        ------
        InfrastructureError
            If that is not possible.
        """

    @abstractmethod
    def submit(self, chunk: Sequence[Task]) -> None:
        """Take a chunk without waiting; its tasks run in order on one worker."""

    @abstractmethod
    def wait(self, timeout: float) -> list[Event]:
        """Return what has ended since the last call, after at most about ``timeout`` seconds.

        Raises
        ------
        InfrastructureError
            If the workers cannot be reached any more.
        """

    @property
    @abstractmethod
    def pending(self) -> int:
        """Number of chunks that were submitted and are not yet over."""

    @abstractmethod
    def stop(self) -> None:
        """End the workers at once, whatever they are doing."""
