"""Samples of running trials on their way to the database."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from orchestrate.records import Sample
from orchestrate.runner.retrying_store import RetryingStore
from orchestrate.store import Claim

WRITE_SECONDS = 1.0
"""Least time between two transactions."""


@dataclass
class LiveSamples:
    """Samples that wait for the next transaction, which takes all of them."""

    store: RetryingStore
    _waiting: list[tuple[Claim, Sample]] = field(default_factory=list)
    _next: float = 0.0

    def add(self, claim: Claim, sample: Sample) -> None:
        """Write a sample now or later."""
        self._waiting.append((claim, sample))
        self.write()

    def write(self) -> None:
        """Write what waits, if the last transaction was long enough ago."""
        if self._waiting and time.monotonic() >= self._next:
            samples, self._waiting = self._waiting, []
            self.store.sample(samples)
            self._next = time.monotonic() + WRITE_SECONDS
