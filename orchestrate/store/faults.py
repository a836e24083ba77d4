"""Translation of what a database driver raises into sentences."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy.exc import DBAPIError, InterfaceError, InternalError, OperationalError

from orchestrate.store.errors import QueryError, StoreUnavailableError

_SQLITE = {
    "SQLITE_BUSY": "another process has kept it locked for too long; see what holds it open",
    "SQLITE_CANTOPEN": "the file cannot be opened; check that its folder exists and is yours",
    "SQLITE_CORRUPT": "the file is damaged; restore a copy, or move it away and run again",
    "SQLITE_FULL": "the disk is full; make room and run the same command again",
    "SQLITE_IOERR": "reading or writing the disk failed; check the disk and run again",
    "SQLITE_NOTADB": "the file is not a SQLite database; give another path",
    "SQLITE_READONLY": "the file is read-only; make it writable or give another path",
}
_ELSEWHERE = "check that its server runs and answers, then run the same command again"


@contextmanager
def translated(safe_url: str) -> Iterator[None]:
    """Raise ``StoreUnavailableError`` for what the database, not the program, did wrong."""
    try:
        yield
    except DBAPIError as error:
        if not _is_infrastructure(error):
            raise
        raise StoreUnavailableError(
            f"The results database {safe_url} cannot be used: {_advice(error.orig)} "
            f"({_first_line(error)})."
        ) from error


@contextmanager
def translated_query(safe_url: str) -> Iterator[None]:
    """Raise ``QueryError`` for SQL that the user wrote and the database refused."""
    try:
        yield
    except DBAPIError as error:
        raise QueryError(f"The query failed on {safe_url}: {_first_line(error)}.") from error


def _is_infrastructure(error: DBAPIError) -> bool:
    if isinstance(error, OperationalError | InterfaceError | InternalError):
        return True
    # sqlite3 reports damage to the file with the base class and nothing else with it.
    return type(error.orig) is sqlite3.DatabaseError


def _advice(original: BaseException | None) -> str:
    name = getattr(original, "sqlite_errorname", None)
    if name is None:
        return _ELSEWHERE
    primary = "_".join(name.split("_")[:2])  # SQLITE_IOERR_WRITE -> SQLITE_IOERR
    return _SQLITE.get(primary, "SQLite refused; see the reason in brackets")


def _first_line(error: DBAPIError) -> str:
    lines = str(error.orig).strip().splitlines()
    return (lines[0] if lines else type(error.orig).__name__).rstrip(".")
