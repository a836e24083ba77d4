"""Engines of SQLite files: writable with a write-ahead log, or read-only."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

from sqlalchemy import URL, Connection, Engine, create_engine, event
from sqlalchemy.pool import QueuePool

from orchestrate.store import database_url
from orchestrate.store.backends.driver_errors import translated_file
from orchestrate.store.backends.file_locks import patiently
from orchestrate.store.errors import NoDatabaseError, StoreUnavailableError
from orchestrate.store.schema import VIEWS

BUSY_TIMEOUT_SECONDS = 30.0

MAX_LOG_BYTES = 16 * 2**20
"""Size to which the log is truncated after a long read transaction."""


def read_engine(url: URL) -> Engine:
    """Return an engine that cannot write; raise ``NoDatabaseError`` if there is no file."""
    path = existing_path(url)
    return _engine(lambda: _reader(path), _begin)


def _reader(path: Path) -> sqlite3.Connection:
    connection = _connect(read_address(path))
    for (
        name,
        query,
    ) in VIEWS.items():  # first: a stranger may have made views of the file
        connection.execute(f"CREATE TEMP VIEW {name} AS {query}")
    return connection


def existing_path(url: URL) -> Path:
    """Return the path of a database; raise ``NoDatabaseError`` if there is no file."""
    path = database_url.sqlite_path(url)
    with translated_file(database_url.safe(url)):
        there = path.is_file()
    if not there:
        raise NoDatabaseError(
            f"There is no results database at {database_url.safe(url)}: run a launch that writes "
            "it, or give the URL of another one (--db, or the variable DOPT_DB)."
        )
    return path


def write_engine(connect: Callable[[], sqlite3.Connection], path: Path, patience: float) -> Engine:
    """Return an engine whose connections are made by ``connect``, as by :func:`writer`.

    A transaction that reads before it writes fails under load unless it locks at its beginning.
    """

    def begin(connection: Connection) -> None:
        driver = driver_of(connection)

        def locked(seconds: float) -> bool:
            driver.execute(f"PRAGMA busy_timeout = {round(1000 * seconds)}")
            try:
                driver.execute("BEGIN IMMEDIATE")
            except sqlite3.OperationalError as error:
                if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY:  # of any kind
                    raise
            return driver.in_transaction

        patiently(locked, patience, path, path.with_name(f"{path.name}-shm"))

    return _engine(connect, begin)


def filling_engine(path: Path) -> Engine:
    """Return an engine for a new file that no other process reads, without a log and without syncs.

    A file that is not complete after a crash must be deleted.
    """

    def connect() -> sqlite3.Connection:
        connection = _connect(_address(path, "mode=rwc"))
        connection.execute("PRAGMA journal_mode = OFF")
        connection.execute("PRAGMA synchronous = OFF")
        return connection

    return _engine(connect, _begin)


def _begin(connection: Connection) -> None:
    connection.exec_driver_sql("BEGIN")


def _engine(connect: Any, begin: Callable[[Connection], None]) -> Engine:
    engine = create_engine("sqlite://", creator=connect, poolclass=QueuePool)
    event.listen(engine, "begin", begin)
    return engine


def _address(path: Path, mode: str) -> str:
    return f"file:{quote(str(path))}?{mode}"


def _connect(address: str) -> sqlite3.Connection:
    connection = sqlite3.connect(
        address,
        uri=True,
        timeout=BUSY_TIMEOUT_SECONDS,
        isolation_level=None,  # the engine says BEGIN
        check_same_thread=False,  # the pool hands a connection to one thread at a time
    )
    connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
    return connection


def writer(path: Path, create: bool, check: Callable[[], None]) -> sqlite3.Connection:
    """Open a file for writing, or create it; ``check`` refuses it before anything is changed."""
    _refuse_read_only(path)
    check()
    connection = _connect(_address(path, "mode=rwc" if create else "mode=rw"))
    check()
    tables = [row[0] for row in connection.execute("SELECT name FROM sqlite_master")]
    if not tables or "trial" in tables:  # a file of another program is not changed
        connection.execute("PRAGMA journal_mode = WAL")
    # A committed trial survives a power cut. Measured against NORMAL, with trials of 300 rows: 1.4
    # instead of 1.1 ms for one alone, 388,000 instead of 397,000 rows/s for twenty together.
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute(f"PRAGMA journal_size_limit = {MAX_LOG_BYTES}")
    connection.execute("PRAGMA foreign_keys = ON")
    return connection


def watcher(path: Path) -> sqlite3.Connection:
    """Open a file that a writer has open, so that its content can be read if its name is lost.

    The connection cannot write: closed as the last one, it leaves the files as they are.
    """
    connection = _connect(_address(path, "mode=ro"))
    connection.execute("SELECT count(*) FROM sqlite_master")  # opens the log too
    return connection


def _refuse_read_only(path: Path) -> None:
    """Raise ``StoreUnavailableError`` before SQLite creates read-only files beside a read-only one.

    They would stay read-only after the file itself becomes writable.
    """
    for suffix in ("", "-wal", "-shm"):
        file = path.with_name(path.name + suffix)
        if _is_read_only(file):
            raise StoreUnavailableError(
                f"The results database {path} cannot be written, because {file} is read-only: "
                "make it writable or give another path."
            )


def _is_read_only(file: Path) -> bool:
    # Another process may delete the log beside the database at any moment, and create it again.
    try:
        number = file.stat().st_ino
        return not os.access(file, os.W_OK) and file.stat().st_ino == number
    except FileNotFoundError:
        return False


def read_address(path: Path) -> str:
    """Return the address with which SQLite opens a file that it cannot write."""
    # A database in WAL mode is read through two files beside it. On a medium where they cannot be
    # created, there are no writers, and the file is read as immutable.
    wal = path.with_name(path.name + "-wal")
    if not wal.exists() and not os.access(path.parent, os.W_OK):
        return _address(path, "mode=ro&immutable=1")
    return _address(path, "mode=ro")


def driver_of(connection: Connection) -> sqlite3.Connection:
    driver: Any = connection.connection.driver_connection
    return cast("sqlite3.Connection", driver)
