"""How many trials a worker gets at once: about a second of work."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterable

from dopt.spec import TrialSpec
from orchestrate.executors.base import Task

LARGEST = 200
"""Trials in a chunk at most, which bounds what is lost with a worker."""


class Chunks:
    """The trials that wait, cut into chunks by what their like has cost so far.

    Parameters
    ----------
    trials
        In the order in which they are to run.
    seconds
        Work in a chunk.
    slots
        Workers, which may change; towards the end the chunks get smaller, so that all workers end
        together.
    batch
        Trials of one configuration that make a chunk, whatever they cost; None cuts by cost.
    """

    def __init__(
        self, trials: Iterable[TrialSpec], seconds: float, slots: int, batch: int | None = None
    ) -> None:
        self._batch = batch
        self._waiting: deque[TrialSpec] = deque()
        self._alone: deque[TrialSpec] = deque()
        self.add(trials)
        self._seconds = seconds
        self.slots = slots
        self._costs: dict[str, float] = {}

    def __len__(self) -> int:
        return len(self._waiting) + len(self._alone)

    def add(self, trials: Iterable[TrialSpec], *, alone: bool = False) -> None:
        """Let more trials wait, each one for a chunk of its own if ``alone``."""
        if self._batch:
            cells: dict[str, list[TrialSpec]] = {}
            for trial in trials:
                cells.setdefault(trial.config_key, []).append(trial)
            trials = itertools.chain.from_iterable(cells.values())
        (self._alone if alone else self._waiting).extend(trials)

    def observe(self, config_key: str, seconds: float) -> None:
        """Learn what a trial of a configuration has cost."""
        known = self._costs.get(config_key)
        self._costs[config_key] = seconds if known is None else 0.7 * known + 0.3 * seconds

    def next(self) -> list[Task]:
        """Return the next trials; one alone while nothing is known of its configuration."""
        if self._alone:
            trial = self._alone.popleft()
            return [Task(trial.trial_key, trial)]
        if self._batch:
            return self._next_batch(self._batch)
        limit = min(LARGEST, max(1, len(self._waiting) // (2 * self.slots)))
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
