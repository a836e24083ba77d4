"""Connection to Ray, an instance of our own or a running cluster, and a chunk on its workers."""

from __future__ import annotations

import logging
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

import ray

from dopt.errors import DoptError
from orchestrate.errors import InfrastructureError, LaunchError
from orchestrate.executors.base import Prepare, Run, Task, TaskDone, run_task
from orchestrate.executors.limits import Limits, ended_after, limit_memory, pin_threads
from orchestrate.program import exit_code

TASK_OPTIONS: dict[str, Any] = {"num_cpus": 1, "max_retries": 0, "num_returns": "streaming"}
"""One core for each chunk; Ray never repeats it, and streams its outcomes."""

_TOKEN = "RAY_AUTH_TOKEN"


class Connection(ABC):
    """Ray instance that runs chunks."""

    limit: int | None = None
    """Largest number of chunks submitted to Ray at once; None for no limit."""

    @abstractmethod
    def connect(self) -> None:
        """Connect, or raise ``InfrastructureError``, or ``LaunchError`` where nothing can start."""

    @property
    @abstractmethod
    def slots(self) -> int:
        """Number of tasks that run at the same time, now."""

    @abstractmethod
    def run(self, run: Run, tasks: list[Task], limits: Limits) -> Any:
        """Start a chunk and return the stream of its outcomes."""

    @abstractmethod
    def check(self) -> None:
        """Raise ``InfrastructureError`` if Ray is lost."""

    @abstractmethod
    def disconnect(self, *, lost: bool) -> None:
        """Disconnect from Ray, which does not answer any more if it is ``lost``."""

    @staticmethod
    def _init(address: str, **options: Any) -> None:
        if ray.is_initialized():
            ray.shutdown()  # the rest of a lost connection
        # Ray prints more than a hundred lines, such as a memory map, for a lost node.
        ray._private.worker.print_to_stdstream = _print_nothing
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **options)
        except Exception as error:
            raise unreachable(address, error) from None


def unreachable(address: str, error: Exception) -> DoptError:
    """Return the error for a failed connection to Ray."""
    wait = isinstance(error, ConnectionError | TimeoutError) or exit_code(error) != 2
    if address == "local" and isinstance(error, OSError) and not wait:
        return LaunchError(
            f"Ray cannot start ({first_line(error)}): set RAY_TMPDIR, or TMPDIR, to a folder with "
            "a short path that can be written, such as /tmp, or use executor=local."
        )
    return InfrastructureError(
        f"Ray cannot be reached at '{address}' ({first_line(error)}): check launch.ray.address, "
        "or use executor=local."
    )


def first_line(error: Exception) -> str:
    """Return the first line of a Ray error, without the authentication token."""
    lines = str(error).strip().splitlines()
    line = lines[0] if lines else type(error).__name__
    token = os.environ.get(_TOKEN)
    return line.replace(token, "***") if token else line


def _print_nothing(*_: object, **__: object) -> None: ...


_STDERR = 2  # Ray writes it to a log file of the worker on its node


def run_chunk(
    run: Run,
    tasks: list[Task],
    limits: Limits,
    prepare: Prepare | None = None,
) -> Iterator[TaskDone | None]:
    """Run tasks in order; yield None when the first begins, then each outcome as it ends.

    ``prepare`` is called first, on machines where the launch has not called it.
    """
    pin_threads()
    if prepare:
        prepare()
    yield None
    for task in tasks:
        limit_memory(limits, task.memory_factor)
        with ended_after(limits, _STDERR):
            finished = run_task(run, task, limits)
        yield finished
