"""Backend for a database URL."""

from __future__ import annotations

from sqlalchemy import URL

from orchestrate.store.backends.base import Backend
from orchestrate.store.backends.postgresql import PostgreSQLBackend
from orchestrate.store.backends.sqlite import SQLiteBackend

LEASE_SECONDS = 60.0
PATIENCE_SECONDS = 30.0


def make_backend(
    url: URL, lease_seconds: float = LEASE_SECONDS, patience: float = PATIENCE_SECONDS
) -> Backend:
    """Return the backend of a database, without checking or creating anything in it."""
    if url.get_backend_name() == "sqlite":
        return SQLiteBackend(url, patience)
    return PostgreSQLBackend(url, lease_seconds, patience)
