"""A process of the local pool: ``python -m orchestrate.executors.worker SOCKET LAST_WORDS``.

Chunks come in on a socket and outcomes go out on it, one by one. A thread reads, so that neither
side waits for the other with a full pipe, and so that the worker ends with its driver. What the
process is at when it ends by force goes to a second descriptor.
"""

from __future__ import annotations

import faulthandler
import os
import queue
import signal
import sys
import threading
from multiprocessing.connection import Connection

from orchestrate.executors.base import Run, Task
from orchestrate.executors.limits import Limits, die_with_parent, ended_after, limit_memory
from orchestrate.executors.task import run_task
from orchestrate.surroundings import pin_threads


def main(descriptor: int, last_words: int) -> None:
    """Run chunks until the driver closes the socket."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the driver's to handle
    faulthandler.enable(last_words)
    die_with_parent()
    pin_threads()
    connection = Connection(descriptor)
    run: Run
    limits: Limits
    run, limits = connection.recv()
    limit_memory(limits)
    chunks: queue.SimpleQueue[list[Task]] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(connection, chunks), daemon=True).start()
    connection.send(None)  # ready
    while True:
        for task in chunks.get():
            with ended_after(limits, last_words):
                finished = run_task(run, task, limits)
            connection.send(finished)
        connection.send(None)


def _read(connection: Connection, chunks: queue.SimpleQueue[list[Task]]) -> None:
    try:
        while True:
            chunks.put(connection.recv())
    except (EOFError, OSError):
        os._exit(0)  # the driver is gone: nobody would take the outcome of what runs now
    finally:
        os._exit(1)  # out of memory, perhaps: without this thread the worker is of no use


if __name__ == "__main__":
    try:
        main(int(sys.argv[1]), int(sys.argv[2]))
    except (EOFError, OSError):
        os._exit(0)
