"""One SELECT of a user, in a process of its own with limits of time, memory and result.

A database library in this process could be neither interrupted nor kept from filling its memory.
"""

from __future__ import annotations

import io
import os
import pickle
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from sqlalchemy.exc import DBAPIError

from orchestrate.errors import QueryError
from orchestrate.store import query_process
from orchestrate.store.backends.base import is_of_driver, out_of_time, translated_query
from orchestrate.store.query_process import MEMORY_BYTES, Request
from orchestrate.store.records import Table

RESULT_BYTES = 50_000_000
"""Most bytes of an answer."""

_PAUSE_MILLISECONDS = 100
_COMMAND = (sys.executable, "-I", "-S", query_process.__file__)


def run_select(
    request: Request,
    safe_url: str,
    sql: str,
    limit: int | None = None,
    timeout: float | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Table:
    """Return the first ``limit`` rows of the statement.

    ``request`` says how the driver connects. The process is killed after ``timeout`` seconds, when
    its answer is too large, when ``stopped`` says so, and with this process.
    """
    given = {"sql": sql, "seconds": timeout, "limit": None if limit is None else limit + 1}
    request = {**request, **given, "path": [folder for folder in sys.path if folder]}
    with translated_query(safe_url, timeout):
        with _process(request) as process:
            answer = _read(process, timeout, stopped)
        parts = [None, *_unpickled(answer)]
        end = parts.pop()
        if not isinstance(end, dict):
            raise QueryError("The process of the query was killed before its end: run it again.")
        if end["error"] is not None:
            raise _failure(end["error"], sql, safe_url)
    _, _, columns, *rows = parts
    if columns is None:
        raise QueryError("The query returns no rows: give one SELECT.")
    return Table(columns, rows[:limit], cut=limit is not None and len(rows) > limit)


@contextmanager
def _process(request: Request) -> Iterator[subprocess.Popen[bytes]]:
    """Start the process, and kill it at the end of the block."""
    pipe, null = subprocess.PIPE, subprocess.DEVNULL
    try:
        # A session of its own: Ctrl-C is for this process, which kills the other.
        process = subprocess.Popen(
            _COMMAND, bufsize=0, stdin=pipe, stdout=pipe, stderr=null, start_new_session=True
        )
    except OSError as error:
        raise QueryError(
            f"The query needs a process, which cannot be started ({error.strerror}): end others."
        ) from error
    with process:
        try:
            assert process.stdin
            unsent = pickle.dumps(request)
            with suppress(BrokenPipeError):  # it was killed: its answer is empty
                while unsent:
                    unsent = unsent[process.stdin.write(unsent) :]
            yield process
        finally:
            process.kill()


def _read(
    process: subprocess.Popen[bytes], seconds: float | None, stopped: Callable[[], bool]
) -> bytes:
    """Return what the process writes; its time begins with the first byte."""
    assert process.stdout
    answer, end = bytearray(), float("inf")
    poll = select.poll()
    poll.register(process.stdout, select.POLLIN)
    while not stopped():
        if time.monotonic() > end:
            raise out_of_time(seconds)
        if not poll.poll(_PAUSE_MILLISECONDS):
            continue
        part = os.read(process.stdout.fileno(), 2**20)
        if not part:
            return bytes(answer)
        if not answer and seconds is not None:
            end = time.monotonic() + seconds
        answer += part
        if len(answer) > RESULT_BYTES:
            raise QueryError(
                f"The result is larger than {RESULT_BYTES / 1e6:g} MB, the most that a query "
                "returns: select fewer rows or columns, or take 'python -m orchestrate export'."
            )
    raise QueryError("The query was cancelled, because nobody waits for it: run it again.")


def _unpickled(answer: bytes) -> Iterator[Any]:
    stream = io.BytesIO(answer)
    with suppress(EOFError, pickle.UnpicklingError):
        while True:
            yield pickle.load(stream)


def _failure(error: Exception, sql: str, safe_url: str) -> Exception:
    if isinstance(error, MemoryError):
        return QueryError(
            f"The query needs more than {MEMORY_BYTES / 2**30:g} GiB of memory and was ended: "
            "make it smaller."
        )
    if is_of_driver(error):
        return DBAPIError(sql, None, error)
    return QueryError(f"The query failed on {safe_url}: {error}.")
