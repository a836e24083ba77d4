"""Parsing, checking and redaction of database URLs."""

from __future__ import annotations

import os
import re
from pathlib import Path

from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError

from orchestrate.store.errors import StoreError

DEFAULT_URL = "sqlite:///results/results.db"

URL_VARIABLE = "DOPT_DB"
"""Environment variable that names another default database; an empty one counts as unset."""

_EXAMPLES = "sqlite:///results/results.db or postgresql+psycopg://user@host:5432/name"
_SQLITE_FILE = re.compile(r"[\w./-]+\.(db|sqlite3?)")
"""Path of a file in place of a URL; a text that may hold a password does not match."""

_SECRETS = ("password", "sslpassword", "passfile")


def default_url() -> str:
    """Return the database that is used when none is given."""
    return os.environ.get(URL_VARIABLE) or DEFAULT_URL


def parse(url: str) -> URL:
    """Return the URL with its driver; raise ``StoreError`` if it names no supported database.

    The message says whether the URL came from ``DOPT_DB``. It repeats no text other than the path
    of a SQLite file, because a mistyped URL may hold a password.
    """
    source = f" in the environment variable {URL_VARIABLE}"
    where = source if url == os.environ.get(URL_VARIABLE) else ""
    try:
        parsed = make_url(url)
    except (ArgumentError, ValueError):  # the latter for a port that is no number
        form = f"sqlite:///{url}" if _SQLITE_FILE.fullmatch(url) else _EXAMPLES
        raise StoreError(f"The database URL{where} cannot be read: write it as {form}.") from None
    backend = parsed.get_backend_name()
    if backend == "postgresql":
        return parsed.set(drivername="postgresql+psycopg")
    if backend != "sqlite":
        raise StoreError(
            f"A database of kind '{parsed.drivername}'{where} is not supported: give {_EXAMPLES}."
        )
    if parsed.host is not None:
        raise StoreError(
            f"The database URL sqlite://{parsed.host}/...{where} names a host, but SQLite has "
            f"none: write three slashes, sqlite:///{parsed.host}/{parsed.database or 'results.db'}."
        )
    return parsed.set(drivername="sqlite")


def safe(url: URL) -> str:
    """Return the URL without passwords."""
    public = {key: value for key, value in url.query.items() if key not in _SECRETS}
    return url.set(query=public).render_as_string(hide_password=True)


def sqlite_path(url: URL) -> Path:
    """Return the absolute path of a SQLite database, links resolved.

    The lock files are beside the file itself, so that two names of one database share them.
    """
    if url.database in (None, "", ":memory:"):
        raise StoreError(
            "A SQLite database in memory cannot be shared between processes: "
            "give a file, such as sqlite:///results/results.db."
        )
    return Path(str(url.database)).resolve()
