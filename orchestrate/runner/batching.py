"""Chunks of trials for the workers, each of about one second of work."""

from __future__ import annotations

import itertools
from collections import Counter, deque
from collections.abc import Iterable

from dopt.spec.trial import TrialSpec
from orchestrate.executors.base import Task

MAX_CHUNK_TRIALS = 200
"""Largest number of trials in a chunk, which bounds the loss when a worker dies."""


class Chunks:
    """Queue of waiting trials, cut into chunks by the measured cost of their configurations.

    Parameters
    ----------
    trials
        In the order of execution.
    seconds
        Work in a chunk [s].
    slots
        Number of workers, which may change; chunks get smaller towards the end, so that all workers
        finish together.
    batch
        Chunk size in trials of one configuration; None cuts by cost.

    Attributes
    ----------
    pending
        Number of chunks that the workers hold; the scheduler keeps it up to date.
    lone_losses
        Losses of a whole machine while it ran one trial and the launch no other, by trial.
    """

    def __init__(
        self, trials: Iterable[TrialSpec], seconds: float, slots: int, batch: int | None = None
    ) -> None:
        self._batch = batch
        self._waiting: deque[TrialSpec] = deque()
        self._alone: deque[TrialSpec] = deque()
        self._exclusive: deque[TrialSpec] = deque()
        self._exclusive_runs = False
        self.pending = 0
        self.lone_losses: Counter[str] = Counter()
        self.add(trials)
        self._seconds = seconds
        self.slots = slots
        self._costs: dict[str, float] = {}

    def __len__(self) -> int:
        if self.pending and self._exclusive_runs:
            return 0
        return len(self._waiting) + len(self._alone) or (
            0 if self.pending else len(self._exclusive)
        )

    def add_exclusive(self, trials: Iterable[TrialSpec]) -> None:
        """Append trials that run last, and each while no other trial of the launch runs."""
        self._exclusive.extend(trials)

    def add(self, trials: Iterable[TrialSpec], *, alone: bool = False) -> None:
        """Append trials to the queue, each as a chunk of its own if ``alone``."""
        if self._batch:
            by_config: dict[str, list[TrialSpec]] = {}
            for trial in trials:
                by_config.setdefault(trial.config_key, []).append(trial)
            trials = itertools.chain.from_iterable(by_config.values())
        (self._alone if alone else self._waiting).extend(trials)

    def observe(self, config_key: str, seconds: float) -> None:
        """Update the mean cost of a configuration with a measured trial."""
        known = self._costs.get(config_key)
        self._costs[config_key] = seconds if known is None else 0.7 * known + 0.3 * seconds

    def next(self) -> list[Task]:
        """Return the next chunk; one trial while the cost of its configuration is unknown."""
        self._exclusive_runs = not (self._alone or self._waiting)
        for queue in (self._alone, self._exclusive if self._exclusive_runs else ()):
            if queue:
                trial = queue.popleft()
                return [Task(trial.trial_key, trial)]
        if self._batch:
            return self._next_batch(self._batch)
        limit = min(MAX_CHUNK_TRIALS, max(1, len(self._waiting) // (2 * self.slots)))
        chunk: list[Task] = []
        cost = 0.0
        while self._waiting and len(chunk) < limit:
            cost += self._costs.get(self._waiting[0].config_key, self._seconds)
            if chunk and cost > self._seconds:
                break
            trial = self._waiting.popleft()
            chunk.append(Task(trial.trial_key, trial))
        return chunk

    def _next_batch(self, size: int) -> list[Task]:
        """Return the next trials of one configuration."""
        key = self._waiting[0].config_key
        chunk: list[Task] = []
        while self._waiting and len(chunk) < size and self._waiting[0].config_key == key:
            trial = self._waiting.popleft()
            chunk.append(Task(trial.trial_key, trial))
        return chunk
