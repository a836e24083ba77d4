"""Copies of databases as files: of SQLite as a database, of PostgreSQL as an archive of pg_dump."""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path

from sqlalchemy import URL

from orchestrate.errors import StoreError, StoreUnavailableError
from orchestrate.store import database_url

PROGRAM = "pg_dump"

_NOT_WRITTEN = tuple(f"{PROGRAM}: error: could not {verb} " for verb in ("open", "write", "close"))


def back_up_to(base: str, suffix: str, write: Callable[[Path], None]) -> str:
    """Let ``write`` make a file, give it a name that is free, and return that.

    The file gets its name when it is complete; an existing file is never replaced.
    """
    target = _free_name(base, suffix)
    partial = target.with_name(f"{target.name}.partial")
    try:
        write(partial)
        partial.rename(target)
    except OSError as error:
        raise StoreUnavailableError(
            f"The backup {target} cannot be made ({error.strerror or error}): make room or its "
            "folder writable, or make a copy yourself and give --no-backup."
        ) from error
    finally:
        partial.unlink(missing_ok=True)
    return str(target)


def rescue(opened: sqlite3.Connection, path: Path, before: Path | None) -> Path:
    """Copy what an open connection sees to a file beside the path that the database had.

    Where that cannot be written, the copy is made in the temporary folder. It replaces the file
    that was saved before. Raises ``OSError``, ``sqlite3.Error`` or ``StoreUnavailableError`` if
    neither can be written.
    """
    for place in (path, Path(tempfile.gettempdir()) / path.name):
        target = before or _free_name(f"{place}.saved-{os.getpid()}", ".db")
        partial = target.with_name(f"{target.name}.partial")
        try:
            _copy_from(opened, partial, path)
            partial.rename(target)
            return target
        except (OSError, sqlite3.Error, StoreUnavailableError) as error:
            failed = error
            with contextlib.suppress(OSError):
                partial.unlink()
    raise failed


_OF_THE_COPY = {
    "SQLITE_FULL": errno.ENOSPC,
    "SQLITE_READONLY": errno.EROFS,
    "SQLITE_CANTOPEN": errno.EACCES,
    "SQLITE_IOERR_WRITE": errno.EIO,
}
"""Errors of a copy whose source is opened to be read alone."""


@contextmanager
def _of_the_copy(partial: Path) -> Iterator[None]:
    """Raise ``OSError`` for an error that the copy, and not its source, has."""
    try:
        yield
    except sqlite3.OperationalError as error:
        code = _OF_THE_COPY.get(error.sqlite_errorname)
        if code is None:
            raise
        raise OSError(code, os.strerror(code), str(partial)) from error


def _free_name(base: str, suffix: str) -> Path:
    names = chain([f"{base}{suffix}"], (f"{base}-{i}{suffix}" for i in count(2)))
    return next(path for path in map(Path, names) if not path.exists())


def copy_checked(path: Path, partial: Path) -> None:
    """Copy a SQLite database with its log to one file, and check it.

    Raises
    ------
    OSError
        If the copy cannot be written.
    """
    with contextlib.closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as source:
        source.execute("PRAGMA schema_version").fetchone()  # the source can be opened
        _copy_from(source, partial, path)


def _copy_from(source: sqlite3.Connection, partial: Path, path: Path) -> None:
    partial.unlink(missing_ok=True)
    with _of_the_copy(partial), contextlib.closing(sqlite3.connect(partial)) as copy:
        source.backup(copy)
        copy.execute("PRAGMA journal_mode = DELETE")  # one file, complete in itself
        (verdict,) = copy.execute("PRAGMA quick_check(1)").fetchone()
    if verdict != "ok":
        raise StoreUnavailableError(
            f"The results database {path} is damaged ({verdict}): nothing was changed; restore a "
            "copy of it."
        )
    descriptor = os.open(partial, os.O_RDONLY)
    os.fsync(descriptor)
    os.close(descriptor)


def dump(url: URL, schema: str, partial: Path, otherwise: str = "") -> None:
    """Write tables and views of a PostgreSQL schema to an archive for ``pg_restore``.

    The password is in the environment of ``pg_dump``, where other users cannot read it.
    ``otherwise`` ends the advice where the program is missing or older than the server.

    Raises
    ------
    OSError
        If the file cannot be written.
    StoreError
        If ``pg_dump`` is missing or older than the server.
    StoreUnavailableError
        If the database cannot be read.
    """
    address = url.set(drivername="postgresql")._replace(password=None)
    words = [PROGRAM, "--format=custom", f"--schema={schema}", f"--file={partial}"]
    words += ["--dbname", address.render_as_string(hide_password=False)]
    secret = {} if url.password is None else {"PGPASSWORD": str(url.password)}
    try:
        environment = {**os.environ, **secret, "LC_ALL": "C"}
        done = subprocess.run(words, env=environment, capture_output=True, text=True)
    except FileNotFoundError as error:
        raise StoreError(
            f"A backup of PostgreSQL needs the program {PROGRAM}, which is not installed: install "
            "the client programs of PostgreSQL, such as the Debian package "
            f"postgresql-client{otherwise}."
        ) from error
    reason, *details = done.stderr.strip().splitlines() or ["it gave no reason"]
    if "server version mismatch" in reason:
        versions = "; ".join(details).removeprefix(f"{PROGRAM}: detail: ")
        raise StoreError(
            f"{PROGRAM} is older than the server of {database_url.safe(url)} ({versions}): install "
            f"the client programs of the server's version{otherwise}."
        )
    if reason.startswith(_NOT_WRITTEN):
        raise OSError(reason.rstrip("."))
    if done.returncode:
        raise StoreUnavailableError(
            f"{PROGRAM} has not backed up {database_url.safe(url)}: {reason.rstrip('.')}."
        )
