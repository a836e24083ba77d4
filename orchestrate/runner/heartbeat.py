"""A sign of life for the database, whatever the main thread does meanwhile."""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import Self

from orchestrate.store import Store

BEATS = 6
"""Signs of life in one lease, so that a few may fail."""

LAST_SECONDS = 2.0
"""Time that a sign of life that is under way gets at the end."""


class Heartbeat:
    """While it is entered, renews the lease of a launch from a thread of its own.

    It says nothing of a database that went away: the main thread will see that too.
    """

    def __init__(self, store: Store, launch: int, lease_seconds: float) -> None:
        self._store = store
        self._launch = launch
        self._interval = lease_seconds / BEATS
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(LAST_SECONDS)

    def _beat(self) -> None:
        while not self._ended.wait(self._interval):
            with suppress(Exception):  # a beat that fails must not be the last one
                self._store.heartbeat(self._launch)
