"""Processes that write outputs side by side."""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures import wait as futures_wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

from analysis.errors import AnalysisError
from orchestrate.store import Reader

INTERRUPT_INTERVAL = 0.1
"""Seconds between two looks for Ctrl-C."""

T = TypeVar("T")


@contextmanager
def written(
    write: Callable[[Reader, T], None], reader: Reader, tasks: Mapping[str, T], workers: int
) -> Iterator[Callable[[str], None]]:
    """Yield a function that returns when the task of a name is written, by one of ``workers``.

    With one worker or one task it writes in this process. Several are forks of it, which import
    nothing anew, and each opens the database for itself. The function raises what ``write`` does,
    ``AnalysisError`` if a process was killed, and ``KeyboardInterrupt`` after Ctrl-C.
    """
    processes = min(workers, len(tasks))
    if processes < 2:
        yield lambda name: write(reader, tasks[name])
        return
    context = multiprocessing.get_context("fork")
    with (
        _deferred_interrupt() as raise_interrupt,
        ProcessPoolExecutor(processes, context, _ignore_interrupt) as pool,
    ):
        try:
            futures = {name: pool.submit(_write, write, reader.url, tasks[name]) for name in tasks}
        except (OSError, RuntimeError):  # no further process or thread
            for process in multiprocessing.active_children():
                process.kill()  # it would wait for work for ever
            raise

        def wait(name: str) -> None:
            raise_interrupt()
            while not futures_wait([futures[name]], timeout=INTERRUPT_INTERVAL).done:
                raise_interrupt()
            try:
                futures[name].result()
            except BrokenProcessPool as error:
                raise AnalysisError(
                    f"A process was killed before {name} was written, perhaps as memory ran "
                    f"out: give --workers 1."
                ) from error

        try:
            yield wait
        finally:
            pool.shutdown(cancel_futures=True)


def _write(write: Callable[[Reader, T], None], url: str, task: T) -> None:
    with Reader.open(url) as reader:
        write(reader, task)


@contextmanager
def _deferred_interrupt() -> Iterator[Callable[[], None]]:
    """Yield a function that raises ``KeyboardInterrupt`` if Ctrl-C came; nothing else does.

    Raised at once, it could come between two statements of the pool that hold its locks. Threads
    other than the main one never get it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    received: list[int] = []

    def raise_interrupt() -> None:
        if received:
            raise KeyboardInterrupt

    previous = signal.signal(signal.SIGINT, lambda number, _: received.append(number))
    try:
        yield raise_interrupt
    finally:
        signal.signal(signal.SIGINT, previous)
    raise_interrupt()


def _ignore_interrupt() -> None:
    """Leave Ctrl-C, which the whole group of processes gets, to the first of them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
