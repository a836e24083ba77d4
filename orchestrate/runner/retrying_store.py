"""Store that repeats an operation while the results database cannot be reached."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TypeVar

from orchestrate.records import Failure, RunRecord
from orchestrate.runner.signals import undisturbed
from orchestrate.store import (
    Claim,
    OpenConfig,
    OpenTrial,
    Registrable,
    Registration,
    Result,
    Store,
    StoreUnavailableError,
)

FIRST_PAUSE_SECONDS = 0.1
MAX_PAUSE_SECONDS = 3.0
"""Pauses between two tries; each is twice the one before, up to the maximum."""

T = TypeVar("T")
Say = Callable[[str], None]


class RetryingStore:
    """Operations of one launch, each retried for ``seconds`` after its first failure.

    A failed operation may have been executed, with only its answer lost. Each one is therefore
    repeated in a form that is harmless if it was.

    Raises
    ------
    StoreUnavailableError
        From every method, if the database stays unreachable, or at once if waiting cannot help.

    Attributes
    ----------
    alike : bool
        Whether only trials are claimed that code with the fingerprint of this launch registered.
    """

    alike = False

    def __init__(self, store: Store, launch: int, seconds: float, say: Say) -> None:
        self._store = store
        self._launch = launch
        self._seconds = seconds
        self._say = say

    @property
    def safe_url(self) -> str:
        """The URL without a password."""
        return self._store.safe_url

    def hurry(self) -> None:
        """Wait no longer for a database that does not answer; a signal handler may call it."""
        self._seconds = 0.0

    def check(self) -> None:
        """Raise ``DatabaseMovedError`` if the file was removed, renamed or replaced."""
        self._store.check()

    def recover(self) -> None:
        """Put the trials of dead launches back to pending."""
        self._persist(self._store.recover)

    def retry(self, status: str, trial_keys: Sequence[str]) -> None:
        """Put the trials with the status back to pending."""
        self._persist(lambda: self._store.retry(status, trial_keys))

    def register(self, specs: Sequence[Registrable]) -> Registration:
        """Register a grid and return the state of its trials."""
        return self._persist(lambda: self._store.register(self._launch, specs))

    def final_losses(self, trial_keys: Sequence[str]) -> dict[str, float]:
        """Return the final loss of those of the trials that are done and did not diverge."""
        return self._persist(lambda: self._store.final_losses(trial_keys))

    def open_configs(self) -> list[OpenConfig]:
        """Return the configurations that have trials without an outcome for this code."""
        return self._persist(lambda: self._store.open_configs(self._launch))

    def others(self) -> list[tuple[dict[str, str] | None, int]]:
        """Return the fingerprints of other code that registered open trials, and their counts."""
        return self._persist(lambda: self._store.others(self._launch))

    def open_trials(self, config_id: int, size: int, losses: int) -> list[OpenTrial]:
        """Return some pending trials of a configuration that lost fewer launches."""
        words = (self._launch, config_id, size, losses)
        return self._persist(lambda: self._store.open_trials(*words))

    def suspects(self, losses: int) -> list[OpenTrial]:
        """Return the pending trials whose launch was lost that often."""
        return self._persist(lambda: self._store.suspects(self._launch, losses))

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

    def release(self, trial_keys: Sequence[str], cause: str) -> None:
        """Put trials of the launch back to pending, and record the cause in their attempts."""
        self._persist(lambda: self._store.release(self._launch, trial_keys, cause))

    def release_all(self) -> None:
        """Put all trials of the launch back to pending; call it while none of them runs.

        A server may commit a claim after its connection broke, and so after the claim was repeated
        without success.
        """
        self._persist(lambda: self._store.release(self._launch))

    def end(self, state: str, exit_code: int) -> None:
        """End the launch in the given state and release its last claims."""
        self._persist(lambda: self._store.end_launch(self._launch, state, exit_code))

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
