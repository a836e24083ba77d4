"""SQLite: one writer at a time, write-ahead log, liveness by kernel file locks."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import URL, Connection, Engine, Select, create_engine, event, func, select
from sqlalchemy.pool import QueuePool

from orchestrate.store import address
from orchestrate.store.backend import Backend, LaunchLife
from orchestrate.store.errors import NoDatabaseError, StoreUnavailableError
from orchestrate.store.locks import LaunchLocks, file_lock
from orchestrate.store.records import Array
from orchestrate.store.schema import STEP_VALUES

BUSY_TIMEOUT_SECONDS = 30.0

# Rows in one statement: its 502 parameters stay below the 999 that every SQLite takes.
_BLOCK = 100


class SQLiteBackend(Backend):
    """A SQLite file, with its locks in the folder ``<file>-locks`` beside it."""

    def __init__(self, url: URL) -> None:
        self._path = address.sqlite_path(url)
        self._folder = self._path.with_name(self._path.name + "-locks")
        super().__init__(_write_engine(self._path), address.safe(url))
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StoreUnavailableError(
                f"The results database {self.safe_url} needs the folder {self._folder}, which "
                f"cannot be made ({error.strerror}): make it writable or give another path."
            ) from error
        self._locks = LaunchLocks(self._folder)

    @contextmanager
    def creation(self) -> Iterator[Connection]:
        # The change to WAL happens outside transactions and fails when two processes try it.
        with file_lock(self._folder / "create"), self.transaction() as connection:
            yield connection

    def exclusive(self, connection: Connection) -> None:
        """Do nothing: BEGIN IMMEDIATE lets one transaction in at a time."""

    def members(self, keys: Sequence[str]) -> Select[Any]:
        return select(func.json_each(json.dumps(list(keys))).table_valued("value").c.value)

    def insert_steps(self, connection: Connection, trial_id: int, values: Array) -> None:
        whole = len(values) - len(values) % _BLOCK
        for start, part, size in ((0, values[:whole], _BLOCK), (whole, values[whole:], None)):
            if len(part):
                _insert_blocks(connection, trial_id, start, part, size or len(part))

    def hold(self, connection: Connection, launch_id: int, token: str) -> None:  # noqa: ARG002
        self._locks.acquire(token)

    def renew(self, connection: Connection, launch_id: int) -> None:
        """Do nothing: the kernel knows."""

    def dead(self, connection: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:  # noqa: ARG002
        return [launch for launch in launches if not self._locks.is_held(launch.token)]

    def let_go(self, token: str) -> None:
        self._locks.release(token)

    def close(self) -> None:
        self._locks.close()
        self.engine.dispose()


def _insert_blocks(
    connection: Connection, trial_id: int, start: int, values: Array, size: int
) -> None:
    blocks = values.reshape(-1, size * values.shape[1]).tolist()
    connection.exec_driver_sql(
        _insert_block(size),
        # SQLite stores a bound NaN as NULL.
        [(trial_id, start + i * size, *numbers) for i, numbers in enumerate(blocks)],
    )


@cache
def _insert_block(n: int) -> str:
    """Return an INSERT of n steps in a row; ?1 is the trial, ?2 the first t, then row by row.

    Sharing the first two parameters, and the statement, between many rows is nearly twice as fast
    as one row a statement through ``executemany``.
    """
    width = len(STEP_VALUES)
    rows = (
        f"(?1, ?2 + {i}, {', '.join(f'?{3 + width * i + j}' for j in range(width))})"
        for i in range(n)
    )
    return f"INSERT INTO step (trial_id, t, {', '.join(STEP_VALUES)}) VALUES {', '.join(rows)}"


def read_engine(url: URL) -> Engine:
    """Return an engine that cannot write; raise ``NoDatabaseError`` where there is no file."""
    path = address.sqlite_path(url)
    if not path.is_file():
        raise NoDatabaseError(
            f"There is no results database at {address.safe(url)}: run a launch that writes it, "
            "or give the URL of another one."
        )
    return _engine(lambda: _connect(path, _read_mode(path)), "BEGIN")


def _write_engine(path: Path) -> Engine:
    # A transaction that reads first and then writes fails under load unless it locks at once.
    return _engine(lambda: _writer(path), "BEGIN IMMEDIATE")


def _engine(connect: Any, begin: str) -> Engine:
    engine = create_engine("sqlite://", creator=connect, poolclass=QueuePool)

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        connection.exec_driver_sql(begin)

    return engine


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    connection = sqlite3.connect(
        f"file:{quote(str(path))}?{mode}",
        uri=True,
        timeout=BUSY_TIMEOUT_SECONDS,
        isolation_level=None,  # the engine says BEGIN
        check_same_thread=False,  # the pool hands a connection to one thread at a time
    )
    connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
    return connection


def _writer(path: Path) -> sqlite3.Connection:
    connection = _connect(path, "mode=rwc")
    connection.execute("PRAGMA journal_mode = WAL")
    # A power failure may cost the last trials, never the file, and they simply run again.
    connection.execute("PRAGMA synchronous = NORMAL")
    connection.execute("PRAGMA foreign_keys = ON")
    return connection


def _read_mode(path: Path) -> str:
    # A database in WAL mode is read through two files beside it. On a medium where they cannot be
    # made, nobody writes either, and the file may be taken as it is.
    wal = path.with_name(path.name + "-wal")
    if not wal.exists() and not os.access(path.parent, os.W_OK):
        return "mode=ro&immutable=1"
    return "mode=ro"
