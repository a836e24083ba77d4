"""Interface of a database backend: the operations that differ between SQLite and PostgreSQL."""

from __future__ import annotations

import logging
import uuid
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

from sqlalchemy import Connection, Engine, Select

from orchestrate.store.backends.driver_errors import translated
from orchestrate.store.records import Array

ANNOUNCE_SECONDS = 2.0
"""Wait for a lock of another process after which a warning says who holds it."""

log = logging.getLogger("dopt.store")

# The operation on a broken connection raises an error; the pool would add a traceback.
logging.getLogger("sqlalchemy.pool").setLevel(logging.CRITICAL)


@dataclass(frozen=True)
class LaunchLife:
    """Token and lease of a launch, which decide whether it is alive."""

    launch_id: int
    token: str
    lease_until: float | None


class NewTrial(NamedTuple):
    """Trial that is registered: nothing of it has run."""

    trial_key: str
    config_id: int
    seed: int


class Backend(ABC):
    """Writable database; methods with a connection run in its transaction."""

    def __init__(self, engine: Engine, safe_url: str) -> None:
        self.engine = engine
        self.safe_url = safe_url
        self._has_answered = False
        """Whether the database has the table of packed curves."""

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        """Run the block in one writing transaction."""
        opening = not self._has_answered
        errors = translated(self.safe_url, known_host=not opening, opening=opening)
        with errors, self.engine.begin() as connection:
            self._has_answered = True
            yield connection

    def check(self) -> None:  # noqa: B027  a server has no file that can be moved
        """Raise ``DatabaseMovedError`` if the URL names another file than the opened one.

        What the opened one holds is then saved in another file.
        """

    @abstractmethod
    def creation(self) -> AbstractContextManager[Connection]:
        """Open a transaction that only one process can hold at a time."""

    @abstractmethod
    def back_up(self, connection: Connection, version: int) -> str:
        """Copy the database of the given version to a new file and return its path."""

    @abstractmethod
    def exclusive(self, connection: Connection) -> None:
        """Keep other launches from registering or recovering until the transaction ends."""

    @abstractmethod
    def members(self, keys: Sequence[str]) -> Select[Any]:
        """Return the keys as a one-column query, for ``IN``; any number of them."""

    @abstractmethod
    def insert_trials(
        self, connection: Connection, trials: Sequence[NewTrial], launch_id: int
    ) -> None:
        """Write pending trials of a launch, of which none is in the database."""

    @abstractmethod
    def insert_steps(
        self, connection: Connection, trial_id: int, values: Array, first: int = 0
    ) -> None:
        """Write steps of a trial from t = ``first`` on, (T, number of STEP_VALUES).

        NaN becomes NULL.
        """

    @abstractmethod
    def hold(self, connection: Connection, launch_id: int, token: str) -> None:
        """Mark a new launch as alive, before others can see it."""

    @abstractmethod
    def renew(self, connection: Connection, launch_id: int) -> None:
        """Extend the life of the launch."""

    @abstractmethod
    def dead(self, connection: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:
        """Return the launches whose process is gone."""

    def token(self) -> str:
        """Return a unique name for a launch of this process."""
        return uuid.uuid4().hex

    @property
    @abstractmethod
    def needs_rest(self) -> bool:
        """Whether :meth:`vacuum` keeps launches from writing for as long as it takes."""

    @abstractmethod
    def vacuum(self) -> None:
        """Free the space of deleted rows."""

    @abstractmethod
    def evict(self) -> None:
        """End the transactions of dead launches, which could keep their locks forever."""

    @abstractmethod
    def forget(self, token: str) -> None:
        """Delete the lock of a launch that has ended or died."""

    @abstractmethod
    def close(self) -> None:
        """Close connections and locks; launches that did not end count as dead."""
