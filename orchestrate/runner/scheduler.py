"""Scheduler of a launch: orders and claims trials, submits them, and commits their outcomes."""

from __future__ import annotations

import itertools
import os
import socket
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

from dopt.errors import UnusableEnvironmentError
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.config import Grid, LaunchSettings
from orchestrate.errors import LaunchError
from orchestrate.executors.base import Executor, Task, TaskDone, WorkerLost, executor_factory
from orchestrate.executors.limits import BYTES_PER_GIB
from orchestrate.records import ENVIRONMENT, Failure, RunRecord
from orchestrate.runner.progress import Tally
from orchestrate.runner.saving import RetryingStore
from orchestrate.store import Claim, InvalidResultError

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
        most = min(MAX_CHUNK_TRIALS, max(1, len(self._waiting) // (2 * self.slots)))
        chunk: list[Task] = []
        cost = 0.0
        while self._waiting and len(chunk) < (self._batch or most):
            key = self._waiting[0].config_key
            cost += self._costs.get(key, self._seconds)
            full = (
                chunk[0].spec.config_key != key if self._batch and chunk else cost > self._seconds
            )
            if chunk and full:
                break
            trial = self._waiting.popleft()
            chunk.append(Task(trial.trial_key, trial))
        return chunk


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
    name = f"a trial of env={largest.system.name} policy={largest.policy.name}"
    if settings.memory_gib is not None and largest.memory > settings.memory_gib * BYTES_PER_GIB:
        raise LaunchError(
            f"{name} needs {_gib(largest.memory)} of memory, but launch.memory_gib allows "
            f"{settings.memory_gib:g} GiB: raise it, or make {largest.largest_setting} smaller."
        )
    factory = executor_factory(settings)
    at_once = factory.trials_at_once(settings)
    if at_once is None:
        return
    available = memory_of_this_machine() if machine is None else machine
    if largest.memory > available:
        raise LaunchError(
            f"{name} needs {_gib(largest.memory)} of memory, but this machine has "
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


def _gib(count: int) -> str:
    gib = count / BYTES_PER_GIB
    return f"{gib:,.3g} GiB" if gib < 1000 else f"{count >> 30:,} GiB"


POLL_SECONDS = 0.2
NODE_LOST = "node lost"
OUT_OF_MEMORY = "out of memory"

MAX_WORKER_LOSSES = 2
"""Worker deaths while a trial runs alone after which the trial fails."""

SUSPECT_LOSSES = 3
"""Losses of a whole machine, or of a launch, after which a trial runs while no other one does.

A preemption takes all trials of a machine, and which trial it finds there is chance: its losses
never count. A trial that takes its machine down is the only one left when nothing runs beside it.
"""

MAX_LONE_LOSSES = 10
"""Losses of a whole machine that ran only this trial after which the trial fails."""


class Stop(Protocol):
    """Request to start no further trials."""

    @property
    def stop_requested(self) -> bool: ...


@dataclass
class Scheduler:
    """Runs the waiting trials of one launch.

    Attributes
    ----------
    owned_by_others
        Number of trials that other launches have claimed.
    refused
        Number of results that came after the lease had run out and another launch had claimed their
        trials: they are not stored.
    failures
        Number of failures by cause.
    retry_memory
        Factor on the limit of memory for a trial that exceeded it; None fails it at once.
    """

    store: RetryingStore
    executor: Executor
    chunks: Chunks
    tally: Tally
    stop: Stop
    fail_fast: bool = False
    retry_memory: float | None = None
    owned_by_others: int = 0
    refused: int = 0
    failures: Counter[str] = field(default_factory=Counter)
    _running: dict[str, tuple[Claim, TrialSpec]] = field(default_factory=dict)
    _crash_counts: Counter[str] = field(default_factory=Counter)
    _node_losses: Counter[str] = field(default_factory=Counter)
    _out_of_memory: set[str] = field(default_factory=set)

    def step(self) -> bool:
        """Submit waiting trials and commit finished ones; return False when none is left.

        Raises UnusableEnvironmentError if a trial found that none can run; then it has no outcome.
        """
        self._fill()
        if not self.executor.pending:
            return False
        events = self.executor.wait(POLL_SECONDS)
        self._commit([event for event in events if isinstance(event, TaskDone)])
        for event in events:
            if isinstance(event, WorkerLost):
                self._recover(event)
        self.store.check()
        return True

    @property
    def ending(self) -> bool:
        """Return whether no further trial starts."""
        return self.stop.stop_requested or (self.fail_fast and bool(self.failures))

    def _fill(self) -> None:
        self.chunks.slots = self.executor.slots
        while not self.ending and self.executor.pending < 2 * self.executor.slots:
            self.chunks.pending = self.executor.pending
            tasks = self.chunks.next() if len(self.chunks) else []
            # A trial that was taken away and waits again may still run here: first its result.
            tasks = [task for task in tasks if task.key not in self._running]
            if not tasks:
                return
            claims = self.store.claim([task.key for task in tasks])
            held = {claim.trial_key: claim for claim in claims}
            self.owned_by_others += len(tasks) - len(held)
            mine = [task for task in tasks if task.key in held]
            self._running |= {task.key: (held[task.key], task.spec) for task in mine}
            more = self.retry_memory or 1.0
            self.executor.submit(
                [
                    replace(task, memory_factor=more) if task.key in self._out_of_memory else task
                    for task in mine
                    if not self._give_up(task.key)
                ]
            )

    def _commit(self, events: Sequence[TaskDone]) -> None:
        results: list[tuple[Claim, TrialResult, RunRecord]] = []
        unusable = ""
        for event in events:
            if isinstance(event.outcome, Failure) and event.outcome.cause == ENVIRONMENT:
                unusable = event.outcome.message
                continue
            if self._wants_more_memory(event):
                self._out_of_memory.add(event.key)
                self.chunks.add(self._release([event.key], OUT_OF_MEMORY), alone=True)
                continue
            claim, trial = self._running.pop(event.key)
            run = _on_this_clock(event.run)
            self.chunks.observe(trial.config_key, run.wall_seconds)
            if isinstance(event.outcome, Failure):
                self._fail(claim, event.outcome, run)
            else:
                results.append((claim, event.outcome, run))
        if results:
            self._write(results)
        if unusable:
            raise UnusableEnvironmentError(unusable)

    def _wants_more_memory(self, event: TaskDone) -> bool:
        """Return whether a trial ran out of memory, and has not had more of it yet."""
        return (
            self.retry_memory is not None
            and isinstance(event.outcome, Failure)
            and event.outcome.cause == OUT_OF_MEMORY
            and event.key not in self._out_of_memory
        )

    def _write(self, results: Sequence[tuple[Claim, TrialResult, RunRecord]]) -> None:
        try:
            written = self.store.commit(results)
        except InvalidResultError as error:
            if len(results) > 1:
                for one in results:
                    self._write([one])
                return
            claim, _, run = results[0]
            self._fail(claim, Failure(type(error).__name__, str(error), "", "malformed"), run)
            return
        self._refuse(written.count(False))
        for (_, result, _), accepted in zip(results, written, strict=True):
            self.tally.diverged += accepted and result.diverged
            self.tally.done += accepted and not result.diverged

    def _fail(self, claim: Claim, failure: Failure, run: RunRecord) -> None:
        if self.store.fail(claim, failure, run):
            self.tally.failed += 1
            first = next(iter(failure.message.splitlines()), "")
            timeout = failure.cause == "timeout"
            self.failures[first if timeout else f"{failure.type}: {first}"] += 1
        else:
            self._refuse(1)

    def _refuse(self, count: int) -> None:
        self.refused += count
        self.owned_by_others += count

    def _recover(self, lost: WorkerLost) -> None:
        """Queue the trials of a process that died, each alone; fail those that killed it twice."""
        if lost.node_lost:
            self._recover_node(lost)
            return
        if len(lost.keys) == 1 and not self.stop.stop_requested:  # a kill may belong to the stop
            self._crash_counts.update(lost.keys)
        limit = 1 if lost.cause == "timeout" else MAX_WORKER_LOSSES
        again = [key for key in lost.keys if self._crash_counts[key] < limit]
        self.chunks.add(self._release(again, lost.cause), alone=True)
        for key in set(lost.keys) - set(again):
            self._fail(self._running.pop(key)[0], _loss_failure(lost, limit), _last_run(lost))

    def _recover_node(self, lost: WorkerLost) -> None:
        """Queue the trials of a lost machine; fail one that was alone there too often."""
        self._node_losses.update(lost.keys)
        if len(self._running) == 1:
            self.chunks.lone_losses.update(lost.keys)
        again = [key for key in lost.keys if not self._give_up(key, lost)]
        suspects = [key for key in again if self._node_losses[key] >= SUSPECT_LOSSES]
        self.chunks.add(self._release([key for key in again if key not in suspects], NODE_LOST))
        self.chunks.add_exclusive(self._release(suspects, NODE_LOST))

    def _release(self, keys: Sequence[str], cause: str) -> list[TrialSpec]:
        if keys:
            self.store.release(keys, cause)
        return [self._running.pop(key)[1] for key in keys]

    def _give_up(self, key: str, lost: WorkerLost | None = None) -> bool:
        """Fail a trial that took its machine down too often; return whether it did."""
        if self.chunks.lone_losses[key] < MAX_LONE_LOSSES:
            return False
        lost = lost or WorkerLost((key,), "no sign of life", node_lost=True)
        failure = _loss_failure(lost, self.chunks.lone_losses[key])
        self._fail(self._running.pop(key)[0], failure, _last_run(lost))
        return True


def _loss_failure(lost: WorkerLost, times: int) -> Failure:
    if lost.cause == "timeout":
        return Failure("TrialTimeoutError", lost.reason, lost.traceback, lost.cause)
    lost_part, only = ("node was lost", " only") if lost.node_lost else ("worker died", "")
    often = {1: "once", 2: "twice"}.get(times, f"{times} times")
    message = f"{lost_part} {often} while running{only} this trial (last: {lost.reason})"
    cause = NODE_LOST if lost.node_lost else lost.cause
    return Failure("WorkerLost", message, lost.traceback, cause)


def _on_this_clock(run: RunRecord) -> RunRecord:
    """Return a run that has just ended with its times by the clock that its claim has.

    The clock of another machine may differ.
    """
    if run.node == socket.gethostname():
        return run
    now = datetime.now(UTC)
    return replace(run, started=now - abs(run.ended - run.started), ended=now)


def _last_run(lost: WorkerLost) -> RunRecord:
    """Return the record of a run that was not measured."""
    now = datetime.now(UTC)
    return RunRecord(lost.node, lost.pid, 0.0, 0.0, 0, now, now)
