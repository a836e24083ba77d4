"""Backup of a results database to a file, while launches write to it."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import URL

from orchestrate.files import whole
from orchestrate.store import database_url
from orchestrate.store.backends.backups import copy_checked, dump
from orchestrate.store.backends.driver_errors import translated
from orchestrate.store.backends.sqlite_engine import existing_path
from orchestrate.store.errors import StoreError
from orchestrate.store.read.reader import Reader


def back_up(url: str, target: Path) -> int:
    """Write a consistent copy of a database to a new file and return its bytes.

    That of SQLite is a database file, checked and complete in itself; that of PostgreSQL is an
    archive for ``pg_restore`` with the tables and views of the schema. The file gets its name when
    it is complete. Raises ``StoreError`` if the file exists, ``OutputError`` if it cannot be
    written, and ``StoreUnavailableError`` if the database cannot be read.
    """
    if target.exists():
        raise StoreError(f"The file {target} exists, a new one is expected: give another name.")
    with whole(target, "FILE") as partial:
        _copy(database_url.parse(url), url, partial)
    return target.stat().st_size


def _copy(parsed: URL, url: str, partial: Path) -> None:
    if parsed.get_backend_name() == "postgresql":
        with Reader.open(url) as reader:
            ((schema,),) = reader.rows("SELECT quote_ident(current_schema())")
        dump(parsed, schema, partial)
        return
    with translated(database_url.safe(parsed)):
        copy_checked(existing_path(parsed), partial)
