"""Program that runs one SELECT of a user, through the driver alone, with a limit of its memory.

It is started as a file, so that nothing of this package is imported. Its standard input holds the
pickled request and stays open: the end of the input ends this process. Its standard output takes
pickles: True for an open database, the names of the columns or None, the rows, {"error": ...}.
"""

from __future__ import annotations

import _thread
import os
import pickle
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from typing import Any

MEMORY_BYTES = 2**30
"""Most address space, and most bytes of a temporary file."""

_MAX_VALUE_BYTES = 2**26  # holds the parameters of a network with 2,800 units in each layer
_BUSY_SECONDS = 30.0
_SAFE_PRAGMAS = ("table_info", "table_xinfo", "table_list", "index_list", "index_xinfo")
_MAX_ROWS = 1024
"""Rows that are asked for at once; fewer at first, because a row may be large."""

_SESSION = (
    "SET default_transaction_read_only = on",
    # A server ends a statement whose client is gone (PostgreSQL 14 or newer, on Linux).
    "SELECT set_config(name, '1s', false) FROM pg_settings "
    "WHERE name = 'client_connection_check_interval' AND version() LIKE '%linux%'",
)

Request = dict[str, Any]
"""``driver``, how it connects, ``path`` to import it, ``sql``, ``limit`` of rows, ``seconds``."""


def main() -> None:
    request: Request = pickle.load(sys.stdin.buffer)
    _thread.start_new_thread(_end_with_parent, ())
    for kind in (resource.RLIMIT_AS, resource.RLIMIT_FSIZE):
        with suppress(ValueError):  # a smaller limit stays
            resource.setrlimit(kind, (MEMORY_BYTES, MEMORY_BYTES))
    sys.path += request["path"]
    error = None
    with os.fdopen(1, "wb") as out:
        try:
            rows = _sqlite(request) if request["driver"] == "sqlite" else _postgresql(request)
            for part in rows:
                out.write(pickle.dumps(part, 5))
                if part is True:
                    out.flush()
        except Exception as failure:
            error = failure
        out.write(pickle.dumps({"error": error}, 5))


def _end_with_parent() -> None:
    os.read(0, 1)
    os._exit(1)


def _sqlite(request: Request) -> Iterator[Any]:
    import sqlite3

    def may_read(action: int, name: str | None, *_: str | None) -> int:
        reads = action == sqlite3.SQLITE_PRAGMA and name in _SAFE_PRAGMAS
        # Table-valued functions, such as json_each, are declared like a change of the catalogue;
        # SQLite itself rejects statements that would change it.
        declares = action == sqlite3.SQLITE_UPDATE and name == "sqlite_master"
        return sqlite3.SQLITE_OK if action in reading or reads or declares else sqlite3.SQLITE_DENY

    reading = (
        sqlite3.SQLITE_SELECT,
        sqlite3.SQLITE_READ,
        sqlite3.SQLITE_FUNCTION,
        sqlite3.SQLITE_RECURSIVE,
    )
    connection = sqlite3.connect(request["file"], uri=True, timeout=_BUSY_SECONDS)
    connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_VALUE_BYTES)
    connection.isolation_level = None
    connection.set_authorizer(may_read)
    yield True
    try:
        cursor = connection.execute(request["sql"])
        yield _names(cursor.description)
        yield from islice(cursor, request["limit"])
    except sqlite3.OperationalError as error:
        # The database is only read: what cannot be written is a temporary file.
        if error.sqlite_errorname in ("SQLITE_FULL", "SQLITE_IOERR_WRITE"):
            raise MemoryError from None
        raise


def _postgresql(request: Request) -> Iterator[Any]:
    import psycopg

    with psycopg.connect(autocommit=True, **request["connection"]) as connection:
        for statement in _SESSION:
            connection.execute(statement)
        yield True
        end = time.monotonic() + (request["seconds"] or 0)

        def limit_time() -> None:  # for each statement again: the one before may have changed it
            left = max(1, round(1000 * (end - time.monotonic()))) if request["seconds"] else 0
            connection.execute(f"SET statement_timeout = {left}")

        try:
            # A server-side cursor accepts one SELECT only; a plain statement may be several.
            with connection.transaction(force_rollback=True), connection.cursor("query") as cursor:
                limit_time()
                connection.execute("SELECT 1")  # now no statement can make the transaction writable
                cursor.execute(request["sql"].encode())
                yield _names(cursor.description)
                left, size = request["limit"] or sys.maxsize, 1
                while left and (rows := cursor.fetchmany(min(size, left))):
                    yield from rows
                    left, size = left - len(rows), min(2 * size, _MAX_ROWS)
                    limit_time()
        except psycopg.Error as error:
            if error.sqlstate is None and "out of memory" in str(error):
                raise MemoryError from None
            raise


def _names(description: Any) -> tuple[str, ...] | None:
    return description and tuple(column[0] for column in description)


if __name__ == "__main__":
    main()
