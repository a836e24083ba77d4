"""Parsing, checking and redaction of database URLs."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path

from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError

from dopt.errors import given_path, stripped
from orchestrate.errors import StoreError
from orchestrate.records import URL_VARIABLE

DEFAULT_URL = "sqlite:///results/results.db"

_IN_MEMORY = ":memory:"
_EXAMPLES = "sqlite:///results/results.db or postgresql+psycopg://user@host:5432/name"
_SQLITE_FILE = re.compile(r"[\w./-]+\.(db|sqlite3?)")
"""Path of a file in place of a URL; a text that may hold a password does not match."""

_SECRETS = ("password", "sslpassword", "passfile")


def default_url() -> str:
    """Return the database that is used when none is given."""
    return os.environ.get(URL_VARIABLE) or DEFAULT_URL


def parse(url: str) -> URL:
    """Return the URL with its driver; raise ``StoreError`` if it names no supported database.

    The path of a file is read as :func:`dopt.errors.given_path` does. The message says whether
    the URL came from ``DOPT_DB``. It repeats no text other than a path, because
    a mistyped URL may hold a password.
    """
    is_default = os.environ.get(URL_VARIABLE, "").strip() == url.strip() != ""
    where = f" in the environment variable {URL_VARIABLE}" if is_default else ""
    url = stripped(url, f"The database URL{where}", StoreError)
    if "://" not in url and Path(url).is_dir():
        raise StoreError(
            f"{url} is a folder, a database is expected{where}: merge the databases in it with "
            f"'python -m orchestrate merge {shlex.quote(url)} --db URL', and give that URL."
        )
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
    if parsed.database and parsed.database != _IN_MEMORY:
        file = given_path(parsed.database, f"The path in the database URL{where}", StoreError)
        parsed = parsed.set(database=str(file))
    return parsed.set(drivername=backend)


def safe(url: URL) -> str:
    """Return the URL without passwords."""
    public = {key: value for key, value in url.query.items() if key not in _SECRETS}
    return url.set(query=public).render_as_string(hide_password=True)


def sqlite_path(url: URL) -> Path:
    """Return the absolute path of a SQLite database, links resolved.

    The lock files are beside the file itself, so that two names of one database share them.
    """
    if url.database in (None, "", _IN_MEMORY):
        raise StoreError(
            "A SQLite database in memory cannot be shared between processes: "
            "give a file, such as sqlite:///results/results.db."
        )
    return Path(str(url.database)).resolve()
