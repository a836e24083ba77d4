"""Heartbeat thread that renews the lease of a launch in the database."""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import Self

from orchestrate.store import Store

HEARTBEATS_PER_LEASE = 6
"""Heartbeats in one lease, so that a few may fail."""

JOIN_TIMEOUT_SECONDS = 2.0
"""Time for the last heartbeat to finish."""


class Heartbeat:
    """Context manager that renews the lease of a launch from a thread.

    It ignores a lost database, which the main thread notices too. A lease that has run out is
    renewed all the same: what others claimed meanwhile is refused when it is committed.
    """

    def __init__(self, store: Store, launch: int, lease_seconds: float) -> None:
        self._store = store
        self._launch = launch
        self._interval = lease_seconds / HEARTBEATS_PER_LEASE
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(JOIN_TIMEOUT_SECONDS)

    def _beat(self) -> None:
        while not self._ended.wait(self._interval):
            with suppress(Exception):  # a failed heartbeat must not be the last one
                self._store.heartbeat(self._launch)
