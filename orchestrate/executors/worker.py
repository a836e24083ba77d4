"""Worker process of the local pool: ``python -m orchestrate.executors.worker`` and descriptors.

Chunks arrive on a socket, and outcomes are sent on it one by one. A thread reads, so that neither
side blocks on a full pipe, and so that the worker ends with its driver. A dying process writes its
stack to the second descriptor, and until it is ready whatever it prints; then that goes to the
third one.
"""

from __future__ import annotations

import faulthandler
import os
import queue
import signal
import sys
import threading
from contextlib import suppress
from multiprocessing.connection import Connection

from dopt.process import collect_rarely
from orchestrate.executors.base import Run, Task, run_task
from orchestrate.executors.limits import (
    Limits,
    die_with_parent,
    ended_after,
    limit_memory,
    pin_threads,
)

HANDLED_BY_DRIVER = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
"""Ctrl-C, and warnings before a preemption, which some batch systems send to every process."""


def main(descriptor: int, crash_report: int, errors: int) -> None:
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
    run, limits = connection.recv()
    chunks: queue.SimpleQueue[list[Task]] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(connection, chunks), daemon=True).start()
    with ended_after(limits, crash_report):
        pass  # a thread that the system does not give fails the start, and no trial
    _hand_over(crash_report, errors)
    connection.send(None)  # ready
    while True:
        for task in chunks.get():
            limit_memory(limits, task.memory_factor)
            with ended_after(limits, crash_report):
                finished = run_task(run, task, limits)
            connection.send(finished)
        connection.send(None)


def _hand_over(crash_report: int, errors: int) -> None:
    """Print to the standard error of the driver from now on; begin with what was printed so far."""
    sys.stdout.flush()
    printed = os.pread(crash_report, os.fstat(crash_report).st_size, 0)
    os.ftruncate(crash_report, 0)
    os.lseek(crash_report, 0, os.SEEK_SET)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(errors, stream.fileno())
    with suppress(OSError):  # nobody reads it any longer
        os.write(errors, printed)


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
        main(*map(int, sys.argv[1:]))
    except (EOFError, ConnectionError):
        os._exit(0)
