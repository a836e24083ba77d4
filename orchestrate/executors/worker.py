"""A process of the local pool: ``python -m orchestrate.executors.worker FD``.

Chunks come in on a socket and outcomes go out on it, one by one. A thread reads, so that neither
side waits for the other with a full pipe, and so that the worker ends with its driver.
"""

from __future__ import annotations

import os
import queue
import signal
import sys
import threading
from multiprocessing.connection import Connection

from orchestrate.executors.base import Run, Task
from orchestrate.executors.task import run_task
from orchestrate.surroundings import pin_threads


def main(descriptor: int) -> None:
    """Run chunks until the driver closes the socket."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the driver's to handle
    pin_threads()
    connection = Connection(descriptor)
    run: Run = connection.recv()
    chunks: queue.SimpleQueue[list[Task]] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(connection, chunks), daemon=True).start()
    connection.send(None)  # ready
    while True:
        for task in chunks.get():
            connection.send(run_task(run, task))
        connection.send(None)


def _read(connection: Connection, chunks: queue.SimpleQueue[list[Task]]) -> None:
    try:
        while True:
            chunks.put(connection.recv())
    except (EOFError, OSError):
        os._exit(0)  # the driver is gone: nobody would take the outcome of what runs now


if __name__ == "__main__":
    try:
        main(int(sys.argv[1]))
    except (EOFError, OSError):
        os._exit(0)
