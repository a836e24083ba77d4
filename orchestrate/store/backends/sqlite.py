"""SQLite: one writer at a time, write-ahead log, liveness by kernel file locks."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Select, func, select

from orchestrate.store import address
from orchestrate.store.backend import Backend, LaunchLife
from orchestrate.store.backup_file import copy_file
from orchestrate.store.errors import StoreError, StoreUnavailableError
from orchestrate.store.faults import translated, translated_file
from orchestrate.store.locks import LaunchLocks, file_lock
from orchestrate.store.records import Array
from orchestrate.store.schema import STEP_VALUES
from orchestrate.store.sqlite_files import driver_of, existing_path, read_engine, write_engine

__all__ = ["SQLiteBackend", "dead", "existing_path", "read_engine", "reading"]

# Rows in one statement: its 502 parameters stay below the 999 that every SQLite takes.
_BLOCK = 100

_READING = (
    sqlite3.SQLITE_SELECT,
    sqlite3.SQLITE_READ,
    sqlite3.SQLITE_FUNCTION,
    sqlite3.SQLITE_RECURSIVE,
)
_SAFE_PRAGMAS = ("table_info", "table_xinfo", "table_list", "index_list", "index_xinfo")
_LONGEST_VALUE = 2**26  # bytes; the parameters of a network of 2800 neurons in each layer fit
_STEPS_BETWEEN_LOOKS = 10_000  # steps of SQLite's machine, well below a millisecond


class SQLiteBackend(Backend):
    """A SQLite file, with its locks in the folder ``<file>-locks`` beside it."""

    def __init__(self, url: URL) -> None:
        self._path = address.sqlite_path(url)
        self._folder = _locks_folder(self._path)
        super().__init__(write_engine(self._path), address.safe(url))
        with translated_file(self.safe_url):
            if self._path.is_dir():
                raise StoreError(
                    f"The results database {self.safe_url} is a folder, but a file is expected: "
                    f"give one in it, such as sqlite:///{self._path / 'results.db'}."
                )
            self._folder.mkdir(parents=True, exist_ok=True)
        self._locks = LaunchLocks(self._folder)

    @contextmanager
    def creation(self) -> Iterator[Connection]:
        # The change to WAL happens outside transactions and fails when two processes try it.
        with self._creation_lock(), self.transaction() as connection:
            yield connection

    @contextmanager
    def rebuilding(self) -> Iterator[Connection]:
        with (
            self._creation_lock(),
            translated(self.safe_url),
            self.engine.connect() as connection,
        ):
            # Dropping a table that is written anew would count as deleting what refers to it. The
            # switch has no effect within a transaction.
            driver_of(connection).execute("PRAGMA foreign_keys = OFF")
            with connection.begin():
                yield connection
                self._check_references(connection)

    def _check_references(self, connection: Connection) -> None:
        broken = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
        if broken:
            raise StoreUnavailableError(
                f"{len(broken)} rows of {self.safe_url} refer to rows that are not there, the "
                f"first of them in the table {broken[0][0]}: nothing was changed; restore a copy."
            )

    def back_up(self, connection: Connection, version: int) -> str:  # noqa: ARG002
        return str(copy_file(self._path, version))

    def discard_backup(self, name: str) -> None:
        Path(name).unlink(missing_ok=True)

    @contextmanager
    def _creation_lock(self) -> Iterator[None]:
        with ExitStack() as stack:
            with translated_file(self.safe_url):
                stack.enter_context(file_lock(self._folder / "create"))
            yield

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
        with translated_file(self.safe_url):
            self._locks.acquire(token)

    def renew(self, connection: Connection, launch_id: int) -> None:
        """Do nothing: the kernel knows."""

    def dead(self, connection: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:  # noqa: ARG002
        return [launch for launch in launches if not self._locks.is_held(launch.token)]

    def evict(self) -> None:
        """Do nothing: the kernel has taken the locks of a dead process back."""

    def let_go(self, token: str) -> None:
        self._locks.release(token)

    def close(self) -> None:
        self._locks.close()
        self.engine.dispose()


def _locks_folder(path: Path) -> Path:
    return path.with_name(path.name + "-locks")


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


def dead(url: URL, _: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:
    """Return those of the launches whose process is gone, for a reader."""
    locks = LaunchLocks(_locks_folder(address.sqlite_path(url)))
    return [launch for launch in launches if not locks.is_held(launch.token)]


@contextmanager
def reading(connection: Connection, seconds: float | None) -> Iterator[None]:
    """Refuse every statement of the block that does more than read the tables, and end slow ones.

    The connection cannot write, attach or load anything; but a temporary table, a setting or the
    end of the transaction would show in what is asked of it later.
    """
    driver = driver_of(connection)
    driver.set_authorizer(_may_read)
    longest = driver.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_VALUE)
    if seconds is not None:
        end = time.monotonic() + seconds
        driver.set_progress_handler(lambda: time.monotonic() > end, _STEPS_BETWEEN_LOOKS)
    try:
        yield
    finally:
        driver.set_authorizer(None)
        driver.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, longest)
        driver.set_progress_handler(None, 0)


def _may_read(action: int, name: str | None, *_: str | None) -> int:
    looks = action == sqlite3.SQLITE_PRAGMA and name in _SAFE_PRAGMAS
    # Functions that return tables, such as json_each, are declared as if the catalogue changed;
    # SQLite itself refuses every statement that would change it.
    declares = action == sqlite3.SQLITE_UPDATE and name == "sqlite_master"
    return sqlite3.SQLITE_OK if action in _READING or looks or declares else sqlite3.SQLITE_DENY
