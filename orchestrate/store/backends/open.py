"""Backend for a database URL."""

from __future__ import annotations

import shlex

from sqlalchemy import URL

from orchestrate.store import database_url
from orchestrate.store.backends.base import Backend
from orchestrate.store.backends.postgresql import PostgreSQLBackend
from orchestrate.store.backends.sqlite import SQLiteBackend
from orchestrate.store.errors import StoreError

LEASE_SECONDS = 60.0
PATIENCE_SECONDS = 30.0


def make_backend(
    url: URL, lease_seconds: float = LEASE_SECONDS, patience: float = PATIENCE_SECONDS
) -> Backend:
    """Return the backend of a database, without checking or creating anything in it.

    Raises ``StoreError`` for a bundle, which cannot be written.
    """
    if url.get_backend_name() == database_url.BUNDLE:
        raise StoreError(
            f"{database_url.safe(url)} is a bundle, which is only read, but a database to write to "
            "is expected: copy its trials into one with 'python -m orchestrate merge "
            f"{shlex.quote(database_url.safe(url))} --db sqlite:///results/results.db', and give "
            "that one."
        )
    if url.get_backend_name() == "sqlite":
        return SQLiteBackend(url, patience)
    return PostgreSQLBackend(url, lease_seconds, patience)
