"""Return of the space of deleted rows, and statistics for the planner of queries."""

from __future__ import annotations

from dataclasses import dataclass

from orchestrate.store import database_url, schema_version
from orchestrate.store.backends.base import Backend
from orchestrate.store.backends.driver_errors import translated
from orchestrate.store.backends.open import make_backend
from orchestrate.store.read.reader import Reader
from orchestrate.store.write.launches import refuse_living


@dataclass(frozen=True)
class Vacuumed:
    """Bytes of a database before and after."""

    safe_url: str
    before: int
    after: int


def vacuum(url: str) -> Vacuumed:
    """Give the space of deleted rows back: SQLite to the disk, PostgreSQL to later rows.

    SQLite writes the file anew, for which as much space must be free on its disk, and lets nobody
    else write meanwhile; PostgreSQL works beside launches. Raises as :meth:`Reader.open` does, and
    ``LaunchAliveError`` if a launch is writing to a SQLite file.
    """
    before = _size(url)
    backend = make_backend(database_url.parse(url))
    try:
        _vacuum(backend)
    finally:
        backend.close()
    return Vacuumed(backend.safe_url, before, _size(url))


def _size(url: str) -> int:
    with Reader.open(url) as reader:
        return reader.size()


def _vacuum(backend: Backend) -> None:
    if backend.needs_rest:
        with backend.transaction() as connection:
            schema_version.check(connection, backend.safe_url)
            refuse_living(connection, backend)
    with translated(backend.safe_url):
        backend.vacuum()
