"""Read side of a bundle: a read-only SQLite copy of its Parquet files."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import URL, Connection, Engine

from orchestrate.store import database_url
from orchestrate.store.backends import sqlite
from orchestrate.store.backends.base import LaunchLife
from orchestrate.store.backends.driver_errors import translated, translated_file
from orchestrate.store.bundles.cached import database_of

__all__ = ["dead", "read_engine", "reading", "size"]

reading = sqlite.reading
size = sqlite.size


def read_engine(url: URL) -> Engine:
    """Return an engine that cannot write; raises as :func:`database_of` does."""
    safe_url = database_url.safe(url)
    with translated(safe_url), translated_file(safe_url):
        copy = database_of(database_url.bundle_path(url), safe_url)
    return sqlite.read_engine(URL.create("sqlite", database=str(copy)))


def dead(url: URL, _: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:  # noqa: ARG001
    """Return all launches: none of them writes to a bundle."""
    return list(launches)
