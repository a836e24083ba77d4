"""Worker process of the local pool: ``python -m orchestrate.executors.worker SOCKET CRASH_REPORT``.

Chunks arrive on a socket, and outcomes are sent on it one by one. A thread reads, so that neither
side blocks on a full pipe, and so that the worker ends with its driver. A dying process writes its
stack to the second descriptor.
"""

from __future__ import annotations

import faulthandler
import os
import queue
import signal
import sys
import threading
from multiprocessing.connection import Connection

from dopt.garbage_collection import collect_rarely
from orchestrate.executors.base import Run, Task
from orchestrate.executors.limits import Limits, die_with_parent, ended_after, limit_memory
from orchestrate.executors.live import Live
from orchestrate.executors.task import run_task
from orchestrate.executors.worker_environment import pin_threads

HANDLED_BY_DRIVER = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
"""Ctrl-C, and warnings before a preemption, which some batch systems send to every process."""


def main(descriptor: int, crash_report: int) -> None:
    """Run chunks until the driver closes the socket."""
    for number in HANDLED_BY_DRIVER:
        signal.signal(number, signal.SIG_IGN)
    faulthandler.enable(crash_report)
    die_with_parent()
    pin_threads()
    collect_rarely()
    connection = Connection(descriptor)
    run: Run
    limits: Limits
    seconds: float | None
    run, limits, seconds = connection.recv()
    # The time limit of a trial cannot tear a message apart: the system takes one as short as a
    # sample whole or not at all.
    live = None if seconds is None else Live(seconds, connection.send)
    chunks: queue.SimpleQueue[list[Task]] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(connection, chunks), daemon=True).start()
    connection.send(None)  # ready
    while True:
        for task in chunks.get():
            limit_memory(limits, task.memory_factor)
            with ended_after(limits, crash_report):
                finished = run_task(run, task, limits, live)
            connection.send(finished)
        connection.send(None)


def _read(connection: Connection, chunks: queue.SimpleQueue[list[Task]]) -> None:
    try:
        while True:
            chunks.put(connection.recv())
    except (EOFError, OSError):
        os._exit(0)  # the driver is gone: no one would receive the outcome
    finally:
        os._exit(1)  # out of memory, perhaps: the worker is useless without this thread


if __name__ == "__main__":
    try:
        main(int(sys.argv[1]), int(sys.argv[2]))
    except (EOFError, OSError):
        os._exit(0)
