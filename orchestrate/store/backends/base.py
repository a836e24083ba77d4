"""What differs between the two databases, as one small interface."""

from __future__ import annotations

import logging
import uuid
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Engine, Select

from orchestrate.store.faults import translated
from orchestrate.store.records import Array

# What was asked of a connection that broke says so itself; the pool would add a traceback.
logging.getLogger("sqlalchemy.pool").setLevel(logging.CRITICAL)


@dataclass(frozen=True)
class LaunchLife:
    """What decides whether a launch still lives."""

    launch_id: int
    token: str
    lease_until: float | None


class Backend(ABC):
    """A database to write to; methods that take a connection run in its transaction."""

    def __init__(self, engine: Engine, safe_url: str) -> None:
        self.engine = engine
        self.safe_url = safe_url
        self._answered = False

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        """Run the block in one transaction that may write."""
        with translated(self.safe_url, self._answered), self.engine.begin() as connection:
            self._answered = True
            yield connection

    @abstractmethod
    def creation(self) -> AbstractContextManager[Connection]:
        """Open a transaction that no other process can hold at the same time."""

    @abstractmethod
    def rebuilding(self) -> AbstractContextManager[Connection]:
        """Open a transaction that may change tables, as exclusive as :meth:`creation`."""

    @abstractmethod
    def back_up(self, connection: Connection, version: int) -> str:
        """Copy everything, which has the given version, and return the name of the copy."""

    @abstractmethod
    def discard_backup(self, name: str) -> None:
        """Remove a copy whose transaction was rolled back."""

    @abstractmethod
    def exclusive(self, connection: Connection) -> None:
        """Keep other launches from registering or recovering until the transaction ends."""

    @abstractmethod
    def members(self, keys: Sequence[str]) -> Select[Any]:
        """Return the keys as a one-column query, for ``IN``; any number of them."""

    @abstractmethod
    def insert_steps(self, connection: Connection, trial_id: int, values: Array) -> None:
        """Write the steps of a trial, (T, number of STEP_VALUES); NaN becomes NULL."""

    @abstractmethod
    def hold(self, connection: Connection, launch_id: int, token: str) -> None:
        """Make the launch count as alive, before anybody else can see it."""

    @abstractmethod
    def renew(self, connection: Connection, launch_id: int) -> None:
        """Make the launch count as alive for longer."""

    @abstractmethod
    def dead(self, connection: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:
        """Return those of the launches whose process is gone."""

    def token(self) -> str:
        """Return a name for a launch of this process that no other launch has."""
        return uuid.uuid4().hex

    @abstractmethod
    def evict(self) -> None:
        """End the transactions of dead launches, which could keep their locks for ever."""

    @abstractmethod
    def let_go(self, token: str) -> None:
        """Forget a launch that has ended or died."""

    @abstractmethod
    def close(self) -> None:
        """Give back connections and locks; launches that did not end count as dead."""
