"""Backup of a results database to a file, while launches write to it."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from sqlalchemy import URL

from orchestrate.files import whole
from orchestrate.store import database_url
from orchestrate.store.backends.driver_errors import translated
from orchestrate.store.backends.sqlite_backup import copy_checked
from orchestrate.store.backends.sqlite_engine import existing_path
from orchestrate.store.errors import StoreError, StoreUnavailableError
from orchestrate.store.read.reader import Reader

PROGRAM = "pg_dump"

_NOT_WRITTEN = tuple(f"{PROGRAM}: error: could not {verb} " for verb in ("open", "write", "close"))


def back_up(url: str, target: Path) -> int:
    """Write a consistent copy of a database to a new file and return its bytes.

    That of SQLite is a database file, checked and complete in itself; that of PostgreSQL is an
    archive for ``pg_restore`` with the tables and views of the schema. The file gets its name when
    it is complete. Raises ``StoreError`` if the file exists or the database is a bundle,
    ``OutputError`` if the file cannot be written, and ``StoreUnavailableError`` if the database
    cannot be read.
    """
    if target.exists():
        raise StoreError(f"The file {target} exists, a new one is expected: give another name.")
    with whole(target, "FILE") as partial:
        _copy(database_url.parse(url), url, partial)
    return target.stat().st_size


def _copy(parsed: URL, url: str, partial: Path) -> None:
    if parsed.get_backend_name() == database_url.BUNDLE:
        raise StoreError(
            f"{database_url.safe(parsed)} is a bundle, a database is expected: copy its folder."
        )
    if parsed.get_backend_name() == "postgresql":
        _dump(parsed, url, partial)
        return
    with translated(database_url.safe(parsed)):
        copy_checked(existing_path(parsed), partial)


def _dump(parsed: URL, url: str, partial: Path) -> None:
    """Run ``pg_dump``, with the password in its environment, where other users cannot read it."""
    with Reader.open(url) as reader:
        ((schema,),) = reader.rows("SELECT quote_ident(current_schema())")
    address = parsed.set(drivername="postgresql")._replace(password=None)
    words = [PROGRAM, "--format=custom", f"--schema={schema}", f"--file={partial}"]
    words += ["--dbname", address.render_as_string(hide_password=False)]
    secret = {} if parsed.password is None else {"PGPASSWORD": str(parsed.password)}
    try:
        environment = {**os.environ, **secret, "LC_ALL": "C"}
        done = subprocess.run(words, env=environment, capture_output=True, text=True)
    except FileNotFoundError as error:
        raise StoreError(
            f"A backup of PostgreSQL needs the program {PROGRAM}, which is not installed: install "
            "the client programs of PostgreSQL, such as the Debian package postgresql-client."
        ) from error
    reason = (done.stderr.strip().splitlines() or ["it gave no reason"])[0].rstrip(".")
    if reason.startswith(_NOT_WRITTEN):
        raise OSError(reason)
    if done.returncode:
        raise StoreUnavailableError(
            f"{PROGRAM} has not backed up {database_url.safe(parsed)}: {reason}."
        )
