"""Chunks of trials for the workers, each of about one second of work, and the memory of trials."""

from __future__ import annotations

import itertools
import os
from collections import Counter, deque
from collections.abc import Iterable
from pathlib import Path

from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec
from orchestrate.config.grid import Grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.errors import LaunchError
from orchestrate.executors.base import Task
from orchestrate.executors.registry import executor_factory

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


BYTES_PER_GIB = 2**30
CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


def check_memory(grid: Grid, settings: LaunchSettings, machine: int | None = None) -> None:
    """Refuse a grid whose trials need more memory than there is.

    Parameters
    ----------
    grid, settings
        Trials and settings of the launch. The memory of a cluster and of a GPU is not checked.
    machine
        Bytes of memory; None reads them from this machine.

    Raises
    ------
    LaunchError
        If one trial does not fit, or the trials that run at the same time do not.
    """
    if not grid.trials:
        return
    counts = Counter(trial.config_key for trial in grid.trials)
    configs = {trial.config_key: trial.config for trial in grid.trials}
    keys = sorted(configs, key=lambda key: configs[key].memory, reverse=True)
    largest = configs[keys[0]]
    _check_worker(largest, settings)
    factory = executor_factory(settings)
    at_once = factory.trials_at_once(settings)
    if at_once is None:
        return
    available = memory_of_this_machine() if machine is None else machine
    if largest.memory > available:
        raise LaunchError(
            f"{_name(largest)} needs {_gib(largest.memory)} of memory, but this machine has "
            f"{_gib(available)}: make {largest.largest_setting} smaller."
        )
    needs = [configs[key].memory for key in keys for _ in range(min(counts[key], at_once))]
    together = needs[:at_once]
    if sum(together) > available:
        raise LaunchError(
            f"{len(together)} trials at the same time need {_gib(sum(together))} of memory, but "
            f"this machine has {_gib(available)}: set {factory.limiting_key}="
            f"{available // largest.memory}."
        )


def memory_of_this_machine() -> int:
    """Return the bytes of memory that this process may use."""
    physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        return min(physical, int(CGROUP_LIMIT.read_text()))
    except (OSError, ValueError):  # not in a group, or in one without a limit
        return physical


def _check_worker(config: TrialConfig, settings: LaunchSettings) -> None:
    if settings.memory_gib is not None and config.memory > settings.memory_gib * BYTES_PER_GIB:
        raise LaunchError(
            f"{_name(config)} needs {_gib(config.memory)} of memory, but launch.memory_gib allows "
            f"{settings.memory_gib:g} GiB: raise it, or make {config.largest_setting} smaller."
        )


def _name(config: TrialConfig) -> str:
    return f"a trial of env={config.system.name} policy={config.policy.name}"


def _gib(count: int) -> str:
    return (
        f"{count / BYTES_PER_GIB:,.3g} GiB"
        if count < 1000 * BYTES_PER_GIB
        else f"{count >> 30:,} GiB"
    )
