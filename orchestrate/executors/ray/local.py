"""Private Ray instance on this machine, also where its cores are busy; it ends with the launch."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import ray
from ray._private import services
from ray.job_config import JobConfig

from dopt.errors import DoptError
from dopt.process import usable_cores
from orchestrate.errors import InfrastructureError
from orchestrate.executors.base import Run, Task
from orchestrate.executors.limits import ONE_THREAD, Limits, module_path
from orchestrate.executors.ray.connection import TASK_OPTIONS, Connection, run_chunk

OBJECT_STORE_BYTES = 256 * 2**20
"""Size of the store for outcomes in transfer; by default Ray takes a third of the memory."""


class OwnRay(Connection):
    """Ray with ``workers`` processes, by default one on each core."""

    def __init__(self, workers: int | None) -> None:
        self._workers = workers or usable_cores()

    def connect(self) -> None:
        # Workers inherit this environment, which is seconds faster than a runtime environment.
        os.environ.update({**ONE_THREAD, **module_path()})
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        start(self._start)
        self._task: Any = ray.remote(**TASK_OPTIONS)(run_chunk)

    def _start(self) -> None:
        self._init(
            "local",
            num_cpus=self._workers,
            object_store_memory=OBJECT_STORE_BYTES,
            include_dashboard=False,
            # Of a client's job Ray's workers look for no modules in the working folder.
            job_config=JobConfig(_client_job=True),
        )

    @property
    def slots(self) -> int:
        return self._workers

    def run(self, run: Run, tasks: list[Task], limits: Limits) -> Any:
        return self._task.remote(run, tasks, limits, None)

    def check(self) -> None:
        """Check that Ray's processes run; Ray itself notices after a minute."""
        node: Any = ray._private.worker._global_node
        if node is None:
            return
        dead = {kind for kind, _ in node.dead_processes()} & {"gcs_server", "raylet"}
        if dead:
            raise InfrastructureError(
                f"Ray's {' and '.join(sorted(dead))} has ended: run the same command again "
                "to continue."
            )

    def disconnect(self, *, lost: bool) -> None:  # noqa: ARG002  # there is always a process to end
        ray.shutdown()


START_SECONDS = 120.0
"""Time for Ray's processes to start; Ray itself waits for 30 s, which a busy machine exceeds."""

ATTEMPTS = 2


def start(begin: Callable[[], None]) -> None:
    """Call ``begin``, which starts Ray, and once more if it fails.

    Raises ``InfrastructureError`` with the last reason and the load of the machine, and at once
    what is no ``InfrastructureError``.
    """
    for attempt in range(1, ATTEMPTS + 1):
        before = _children()
        try:
            with _long_start():
                begin()
            return
        except DoptError as error:
            _kill(_children() - before)  # what has started, which would keep the cores busy
            if not isinstance(error, InfrastructureError):
                raise
            if attempt == ATTEMPTS:
                raise InfrastructureError(
                    f"{error} It was tried {ATTEMPTS} times; {_load()}: run the same command again "
                    "when fewer programs run."
                ) from error


@contextmanager
def _long_start() -> Iterator[None]:
    """Let Ray wait for its own node for ``START_SECONDS``: the limit of Ray is a constant in it."""
    query = services.get_node

    def patient(*arguments: Any, **options: Any) -> Any:
        end = time.monotonic() + START_SECONDS
        while True:
            try:
                return query(*arguments, **options)  # type: ignore[no-untyped-call]
            except RuntimeError:
                if time.monotonic() > end or not _raylet_lives():
                    raise

    services.get_node = patient
    try:
        yield
    finally:
        services.get_node = query


def _children() -> set[int]:
    """Return the process ids of the children of this process."""
    lists = Path("/proc/self/task").glob("*/children")
    return {int(number) for one in lists for number in one.read_text().split()}


def _raylet_lives() -> bool:
    """Tell whether a raylet that this process has started has not ended."""
    for process in _children():
        with suppress(OSError):  # it may end at this moment
            status = Path(f"/proc/{process}/status").read_text()
            name, state = re.findall(r"^(?:Name|State):\s+(\S+)", status, re.MULTILINE)
            if name == "raylet" and state not in "ZX":
                return True
    return False


def _kill(processes: set[int]) -> None:
    for process in processes:
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)


def _load() -> str:
    return f"the load is {os.getloadavg()[0]:.1f} on {usable_cores()} cores"
