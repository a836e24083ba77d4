"""The right kind of backend for a URL."""

from __future__ import annotations

from sqlalchemy import URL

from orchestrate.store.backend import Backend
from orchestrate.store.postgresql import PostgreSQLBackend
from orchestrate.store.sqlite import SQLiteBackend

LEASE_SECONDS = 60.0


def make_backend(url: URL, lease_seconds: float = LEASE_SECONDS) -> Backend:
    """Return the write side of a database; nothing is checked or made in it yet."""
    if url.get_backend_name() == "sqlite":
        return SQLiteBackend(url)
    return PostgreSQLBackend(url, lease_seconds)
