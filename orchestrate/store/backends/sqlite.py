"""SQLite backend: one writer at a time, write-ahead log, liveness by kernel file locks."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Select, func, insert, select, text
from sqlalchemy.exc import SQLAlchemyError

from orchestrate.store import database_url
from orchestrate.store.backends.base import Backend, LaunchLife, NewTrial
from orchestrate.store.backends.driver_errors import translated, translated_file
from orchestrate.store.backends.file_locks import LaunchLocks, file_lock
from orchestrate.store.backends.network_file_systems import refuse_unsafe
from orchestrate.store.backends.sqlite_backup import copy_file
from orchestrate.store.backends.sqlite_engine import (
    driver_of,
    existing_path,
    read_address,
    read_engine,
    write_engine,
)
from orchestrate.store.errors import DatabaseMovedError, StoreError, StoreUnavailableError
from orchestrate.store.records import Array
from orchestrate.store.schema import STEP_VALUES, trial

__all__ = ["SQLiteBackend", "dead", "existing_path", "read_engine", "request", "size"]

# Rows in one statement: its 502 parameters stay below the 999 that every SQLite takes.
_BLOCK = 100

_SIZE = text("SELECT page_count * page_size FROM pragma_page_count, pragma_page_size")
_TRUNCATE = "PRAGMA wal_checkpoint(TRUNCATE)"


class SQLiteBackend(Backend):
    """SQLite file, with its locks in the folder ``<file>-locks`` beside it."""

    def __init__(self, url: URL) -> None:
        self._path = database_url.sqlite_path(url)
        self._folder = _locks_folder(self._path)
        super().__init__(write_engine(self._path), database_url.safe(url))
        refuse_unsafe(self._path, self.safe_url)
        with translated_file(self.safe_url):
            if self._path.is_dir():
                raise StoreError(
                    f"The results database {self.safe_url} is a folder, but a file is expected: "
                    f"give one in it, such as sqlite:///{self._path / 'results.db'}."
                )
            self._folder.mkdir(parents=True, exist_ok=True)
        self._locks = LaunchLocks(self._folder)
        self._opened: tuple[int, int] | None = None

    @contextmanager
    def creation(self) -> Iterator[Connection]:
        # The change to WAL is outside transactions and fails if two processes attempt it.
        with self._creation_lock(), self.transaction() as connection:
            self._opened = _identity(self._path)
            yield connection

    @contextmanager
    def saving(self) -> Iterator[Connection]:
        # A write to a file that was removed or renamed succeeds, and nobody finds it.
        self._require_opened()
        with self.transaction() as connection:
            yield connection
            self._require_opened()

    def _require_opened(self) -> None:
        found = _identity(self._path)
        if found != self._opened:
            what = "was removed or renamed" if found is None else "was replaced by another file"
            raise DatabaseMovedError(
                f"The results database {self.safe_url} {what} since it was opened, so that nothing "
                f"was saved: save again to write everything there anew, or give another path."
            )

    @contextmanager
    def rebuilding(self) -> Iterator[Connection]:
        with (
            self._creation_lock(),
            translated(self.safe_url),
            self.engine.connect() as connection,
        ):
            # Dropping a table to rebuild it would violate references. The setting has no effect
            # within a transaction.
            driver_of(connection).execute("PRAGMA foreign_keys = OFF")
            with connection.begin():
                yield connection
                self._check_references(connection)

    def _check_references(self, connection: Connection) -> None:
        broken = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
        if broken:
            raise StoreUnavailableError(
                f"{len(broken)} rows of {self.safe_url} refer to missing rows, the first one in "
                f"the table {broken[0][0]}: nothing was changed; restore a copy."
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

    def insert_trials(self, connection: Connection, trials: Sequence[NewTrial]) -> None:
        rows = [{**one._asdict(), "status": "pending", "attempt": 0} for one in trials]
        connection.execute(insert(trial), rows)

    def insert_steps(
        self, connection: Connection, trial_id: int, values: Array, first: int = 0
    ) -> None:
        whole = len(values) - len(values) % _BLOCK
        for start, part, size in ((0, values[:whole], _BLOCK), (whole, values[whole:], None)):
            if len(part):
                _insert_blocks(connection, trial_id, first + start, part, size or len(part))

    def hold(self, connection: Connection, launch_id: int, token: str) -> None:  # noqa: ARG002
        with translated_file(self.safe_url):
            self._locks.acquire(token)

    def renew(self, connection: Connection, launch_id: int) -> None:
        """Do nothing: the file lock is held until the process ends."""

    def dead(self, connection: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:  # noqa: ARG002
        return [launch for launch in launches if not self._locks.is_held(launch.token)]

    @property
    def needs_rest(self) -> bool:
        return True

    def vacuum(self) -> None:
        with self.engine.connect() as connection:
            driver = driver_of(connection)
            driver.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 1)  # the new file
            driver.execute("VACUUM")
            driver.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
            driver.execute(_TRUNCATE)

    def evict(self) -> None:
        """Do nothing: the kernel releases the locks of a dead process."""

    def forget(self, token: str) -> None:
        self._locks.release(token)

    def close(self) -> None:
        if self._opened not in (None, _identity(self._path)):
            # SQLite leaves the log of a renamed file behind, under the old name.
            with suppress(SQLAlchemyError, sqlite3.Error), self.engine.connect() as connection:
                driver_of(connection).execute(_TRUNCATE)
        self._locks.close()
        self.engine.dispose()


def _identity(path: Path) -> tuple[int, int] | None:
    """Return device and inode of a file, or None if there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


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
    """Return the launches whose process is gone, for a reader."""
    locks = LaunchLocks(_locks_folder(database_url.sqlite_path(url)))
    with translated_file(database_url.safe(url)):
        return [launch for launch in launches if not locks.is_held(launch.token)]


def size(connection: Connection) -> int:
    """Return the bytes of the database, without its log."""
    return int(connection.execute(_SIZE).scalar_one())


def request(url: URL) -> dict[str, Any]:
    """Return how the process of a query opens the file."""
    return {"driver": "sqlite", "file": read_address(existing_path(url))}
