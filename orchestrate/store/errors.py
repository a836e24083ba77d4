"""What can go wrong between a trial and the database; each message is a sentence with advice."""

from __future__ import annotations

from dopt.errors import DoptError


class StoreError(DoptError):
    """Base of everything that the store raises on purpose."""


class StoreUnavailableError(StoreError):
    """The database cannot be reached, is full, locked or damaged: infrastructure, not a trial.

    ``transient`` is True where waiting may help: a server or a connection that went away, or a lock
    that was held for too long.
    """

    def __init__(self, message: str, *, transient: bool = False) -> None:
        super().__init__(message)
        self.transient = transient


class NoDatabaseError(StoreError):
    """There is nothing to read at the given URL."""


class SchemaVersionError(StoreError):
    """The database was written by an older or a newer program."""


class LaunchAliveError(StoreError):
    """A launch is running in a database that should hold still."""


class InvalidResultError(StoreError, ValueError):
    """A trial's result has the wrong shape or contradicts itself; nothing of it was written."""


class QueryError(StoreError, ValueError):
    """A question that the database cannot answer: unknown column, wrong SQL, missing trial."""
