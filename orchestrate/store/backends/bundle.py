"""Read side of a bundle: a read-only SQLite copy of its Parquet files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import URL, Connection, Engine

from orchestrate.store import database_url
from orchestrate.store.backends import sqlite
from orchestrate.store.backends.base import LaunchLife
from orchestrate.store.backends.driver_errors import translated, translated_file
from orchestrate.store.bundles.cached import database_of

__all__ = ["dead", "read_engine", "request", "size"]

size = sqlite.size


def read_engine(url: URL) -> Engine:
    """Return an engine that cannot write; raises as :func:`database_of` does."""
    return sqlite.read_engine(_copy(url))


def request(url: URL) -> dict[str, Any]:
    """Return how the process of a query opens the copy."""
    return sqlite.request(_copy(url))


def _copy(url: URL) -> URL:
    safe_url = database_url.safe(url)
    with translated(safe_url), translated_file(safe_url):
        copy = database_of(database_url.bundle_path(url), safe_url)
    return URL.create("sqlite", database=str(copy))


def dead(url: URL, _: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:  # noqa: ARG001
    """Return all launches: none of them writes to a bundle."""
    return list(launches)
