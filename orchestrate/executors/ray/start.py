"""Start of Ray's processes on this machine, also where its cores are busy."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ray._private import services

from dopt.cores import usable_cores
from dopt.errors import DoptError
from orchestrate.errors import InfrastructureError

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
