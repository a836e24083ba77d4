"""Store of a launch: operations repeated while the database is away, and the heartbeat."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Self, TypeVar

from orchestrate.records import Failure, RunRecord
from orchestrate.runner.progress import undisturbed
from orchestrate.store import Claim, Result, Store, StoreUnavailableError

FIRST_PAUSE_SECONDS = 0.1
MAX_PAUSE_SECONDS = 3.0
"""Pauses between two tries; each is twice the one before, up to the maximum."""

IDEMPOTENT = {
    "recover": False,
    "retry": False,
    "final_losses": False,
    "register": True,
    "open_configs": True,
    "others": True,
    "open_trials": True,
    "suspects": True,
    "release": True,
    "end_launch": True,
}
"""Operations of :class:`Store` that may be executed twice, and whether they take the launch."""

T = TypeVar("T")
Say = Callable[[str], None]


class RetryingStore:
    """Operations of one launch, each retried for ``seconds`` after its first failure.

    A failed operation may have been executed, with only its answer lost. The operations of
    :data:`IDEMPOTENT` are repeated as they are, without the number of the launch as argument;
    ``claim``, ``commit`` and ``fail`` are repeated in a form that is harmless after that.

    Raises
    ------
    StoreUnavailableError
        From every method, if the database stays unreachable, or at once if waiting cannot help.

    Attributes
    ----------
    alike : bool
        Whether only trials are claimed that code with the fingerprint of this launch registered.
    safe_url : str
        The URL without a password.
    """

    alike = False

    def __init__(self, store: Store, launch: int, seconds: float, say: Say) -> None:
        self._store = store
        self._launch = launch
        self._seconds = seconds
        self._say = say
        self.safe_url = store.safe_url

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name not in IDEMPOTENT:
            raise AttributeError(name)
        launch = (self._launch,) if IDEMPOTENT[name] else ()
        operation = partial(getattr(self._store, name), *launch)
        return lambda *words: self._persist(lambda: operation(*words))

    def hurry(self) -> None:
        """Wait no longer for a database that does not answer; a signal handler may call it."""
        self._seconds = 0.0

    def check(self) -> None:
        """Raise ``DatabaseMovedError`` if the file was removed, renamed or replaced."""
        self._store.check()

    def claim(self, trial_keys: Sequence[str]) -> list[Claim]:
        """Claim the pending ones of the trials, none of which the launch holds."""
        only = {"alike": True} if self.alike else {}

        def claim() -> list[Claim]:
            return self._store.claim(self._launch, trial_keys, **only)

        def again() -> list[Claim]:
            self._store.release(self._launch, trial_keys)
            return claim()

        return self._persist(claim, again)

    def commit(self, items: Sequence[tuple[Claim, Result, RunRecord]]) -> list[bool]:
        """Write finished trials; False for each whose claim is lost."""
        claims = [claim for claim, _, _ in items]

        def again() -> list[bool]:
            written = self._store.commit_many(items)
            return written if all(written) else self._store.written(claims)

        return self._persist(lambda: self._store.commit_many(items), again)

    def fail(self, claim: Claim, failure: Failure, run: RunRecord) -> bool:
        """Write a failed trial; False where the claim is lost."""

        def again() -> bool:
            return self._store.fail(claim, failure, run) or self._store.written([claim])[0]

        return self._persist(lambda: self._store.fail(claim, failure, run), again)

    def _persist(self, operation: Callable[[], T], again: Callable[[], T] | None = None) -> T:
        try:
            return _whole(operation)
        except StoreUnavailableError as error:
            if not error.transient:
                raise
            self._say(f"waiting for up to {self._seconds:g} s: {error}")
        return self._repeat(again or operation)

    def _repeat(self, operation: Callable[[], T]) -> T:
        start, pause = time.monotonic(), FIRST_PAUSE_SECONDS
        while True:
            left = start + self._seconds - time.monotonic()
            time.sleep(max(0.0, min(pause, left)))
            pause = min(2 * pause, MAX_PAUSE_SECONDS)
            try:
                result = _whole(operation)
            except StoreUnavailableError as error:
                if not error.transient or time.monotonic() - start >= self._seconds:
                    raise
            else:
                self._say(f"the database is back after {time.monotonic() - start:.1f} s")
                return result


def _whole(operation: Callable[[], T]) -> T:
    with undisturbed():
        return operation()


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
