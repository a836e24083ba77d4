"""SQLite backend: one writer at a time, write-ahead log, liveness by kernel file locks."""

from __future__ import annotations

import json
import os
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Select, func, insert, select, text
from sqlalchemy.exc import SQLAlchemyError

from orchestrate.errors import DatabaseMovedError, StoreError, StoreUnavailableError
from orchestrate.store.backends.base import (
    Backend,
    LaunchLife,
    NewTrial,
    back_up_to,
    copy_checked,
    public_url,
    rescue,
    sqlite_path,
    translated_file,
)
from orchestrate.store.backends.sqlite_engine import (
    LaunchLocks,
    driver_of,
    existing_path,
    file_lock,
    read_address,
    read_engine,
    refuse_unsafe,
    watcher,
    write_engine,
    writer,
)
from orchestrate.store.records import Array
from orchestrate.store.schema import STEP_VALUES, trial

__all__ = ["SQLiteBackend", "dead", "existing_path", "read_engine", "request", "size"]

# Rows in one statement: its 502 parameters stay below the 999 that every SQLite takes.
_BLOCK = 100

_LOGS = ("-wal", "-shm")
_SIZE = text("SELECT page_count * page_size FROM pragma_page_count, pragma_page_size")
_TRUNCATE = "PRAGMA wal_checkpoint(TRUNCATE)"


class SQLiteBackend(Backend):
    """SQLite file, with its locks in the folder ``<file>-locks`` beside it."""

    def __init__(self, url: URL, patience: float) -> None:
        self._path = sqlite_path(url)
        self._given = Path(str(url.database)).absolute()
        self._folder = _locks_folder(self._path)
        self._patience = patience
        self._opened: list[tuple[int, int] | None] = []
        self._watcher: sqlite3.Connection | None = None
        self._moved = ""
        self._saved: Path | None = None
        self._checking = threading.RLock()
        engine = write_engine(self._connect, self._path, patience)
        super().__init__(engine, public_url(url))
        refuse_unsafe(self._path, self.safe_url)
        with translated_file(self.safe_url):
            if self._path.is_dir():
                raise StoreError(
                    f"The results database {self.safe_url} is a folder, but a file is expected: "
                    f"give one in it, such as sqlite:///{self._path / 'results.db'}."
                )
            self._folder.mkdir(parents=True, exist_ok=True)
        self._locks = LaunchLocks(self._folder)

    def _connect(self) -> sqlite3.Connection:
        new = not self._opened
        if new and not self._path.exists():  # the log of a removed file is no log of a new one
            for name in _LOGS:
                Path(f"{self._path}{name}").unlink(missing_ok=True)
        return writer(self._path, new, self.check)

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        with super().transaction() as connection:
            self._remember()
            yield connection
        # What was committed went to the opened file, wherever that is, and is saved with the rest.
        self.check(written=True)

    def _remember(self) -> None:
        """Note which files are open, and keep a connection to them, at the first transaction."""
        if not self._opened:
            self._watcher = watcher(self._path)
            self._opened = self._files()

    def _files(self) -> list[tuple[int, int] | None]:
        """Return the identities of the file that the URL names and of the logs in use."""
        return [_identity(self._given), *(_identity(Path(f"{self._path}{s}")) for s in _LOGS)]

    def check(self, written: bool = False) -> None:
        with self._checking:
            moved = self._moved or (self._opened and self._files() != self._opened)
            if moved and (written or not self._moved):
                self._moved = self._rescued()
                self._empty_log()
            if moved:
                raise DatabaseMovedError(self._moved)

    def _rescued(self) -> str:
        """Save what the opened file holds and return a sentence about it."""
        file, *_ = self._files()
        what = "was replaced by another file" if file else "was removed or renamed"
        if file == self._opened[0]:
            what = f"lost its log {self._path.name}-wal"
        assert self._watcher is not None
        try:
            self._saved = rescue(self._watcher, self._path, self._saved)
            saved = f"what it held is saved in {self._saved}"
            more = "put the saved file in its place and "
        except (OSError, sqlite3.Error, StoreUnavailableError) as error:
            saved = f"what it held cannot be saved beside it or in the temporary folder ({error})"
            more = ""
        place = _place(self._opened[0])
        now = f" and is now {place}" if place not in ("", os.path.realpath(self._given)) else ""
        return (
            f"The results database {self.safe_url} {what} since it was opened{now}; {saved}: {more}"
            "run the same command again to continue (an Explorer that saves again writes all of "
            "it there)."
        )

    @contextmanager
    def creation(self) -> Iterator[Connection]:
        # The change to WAL is outside transactions and fails if two processes attempt it.
        with ExitStack() as stack:
            with translated_file(self.safe_url):
                stack.enter_context(file_lock(self._folder / "create", self._patience))
            yield stack.enter_context(self.transaction())

    def back_up(self, connection: Connection, version: int) -> str:  # noqa: ARG002
        write = partial(copy_checked, self._path)
        return back_up_to(f"{self._path}.v{version}-backup", "", write)

    def exclusive(self, connection: Connection) -> None:
        """Do nothing: BEGIN IMMEDIATE lets one transaction in at a time."""

    def members(self, keys: Sequence[str]) -> Select[Any]:
        return select(func.json_each(json.dumps(list(keys))).table_valued("value").c.value)

    def insert_trials(
        self, connection: Connection, trials: Sequence[NewTrial], launch_id: int
    ) -> None:
        more = {"status": "pending", "attempt": 0, "registered_by": launch_id}
        rows = [{**one._asdict(), **more} for one in trials]
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

    def evict(self) -> None:
        """Do nothing: the kernel releases the locks of a dead process."""

    def forget(self, token: str) -> None:
        self._locks.release(token)

    def close(self) -> None:
        with suppress(DatabaseMovedError):
            self.check()
        self._locks.close()
        if self._moved:
            self.engine.dispose()  # first, as the watcher writes nothing when it is the last one
        if self._watcher:
            self._watcher.close()
        self.engine.dispose()

    def _empty_log(self) -> None:
        """Empty the log of a file that was renamed or replaced, which the next one would read.

        A log that others have made since may share the memory of this one.
        """
        _, log, memory = (a == b for a, b in zip(self._files(), self._opened, strict=True))
        if log or not memory:
            failures = suppress(SQLAlchemyError, sqlite3.Error, StoreError)
            with failures, self.engine.connect() as connection:
                driver_of(connection).execute(_TRUNCATE)
        if log and self._saved and self._opened[0] != _identity(self._path):
            with suppress(OSError):  # no connection of the pool was left
                os.truncate(f"{self._path}-wal", 0)


def _identity(path: Path) -> tuple[int, int] | None:
    """Return device and inode of a file, or None without a file."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _place(identity: tuple[int, int] | None) -> str:
    """Return the present path of an open file; empty if it was deleted, or is not known."""
    with suppress(OSError):
        for link in Path("/proc/self/fd").iterdir():
            if _identity(link) == identity and not str(link.readlink()).endswith(" (deleted)"):
                return str(link.readlink())
    return ""


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
    locks = LaunchLocks(_locks_folder(sqlite_path(url)))
    with translated_file(public_url(url)):
        return [launch for launch in launches if not locks.is_held(launch.token)]


def size(connection: Connection) -> int:
    """Return the bytes of the database, without its log."""
    return int(connection.execute(_SIZE).scalar_one())


def request(url: URL) -> dict[str, Any]:
    """Return how the process of a query opens the file."""
    return {"driver": "sqlite", "file": read_address(existing_path(url))}
