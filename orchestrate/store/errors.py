"""Errors of the results database; each message is one sentence with a remedy."""

from __future__ import annotations

from dopt.errors import DoptError
from orchestrate.errors import InfrastructureError


class StoreError(DoptError):
    """Base of all errors of the results database."""


class StoreUnavailableError(StoreError, InfrastructureError):
    """Database that cannot be reached, or is full, locked or damaged.

    ``transient`` is True if waiting may help: after a lost server or connection, or a lock that was
    held for too long.
    """

    def __init__(self, message: str, *, transient: bool = False) -> None:
        super().__init__(message)
        self.transient = transient


class DatabaseMovedError(StoreUnavailableError):
    """Database file that was removed, renamed or replaced after it was opened."""


class NoDatabaseError(StoreError):
    """No database at the given URL."""


class SchemaVersionError(StoreError):
    """Database of an older or a newer version of the program, or of something else."""


class LaunchAliveError(StoreError):
    """Running launch in a database that must not change."""


class InvalidResultError(StoreError, ValueError):
    """Result of a trial with wrong shapes or contradictory values; nothing was written."""


class QueryError(StoreError, ValueError):
    """Query that the database cannot answer: unknown column, invalid SQL, missing trial."""
