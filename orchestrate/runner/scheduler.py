"""Scheduler of a launch: claims trials, submits them, and commits their outcomes."""

from __future__ import annotations

import socket
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Protocol

from dopt.errors import UnusableEnvironmentError
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.executors.base import Executor, Task, TaskDone, WorkerLost
from orchestrate.records import ENVIRONMENT, Failure, RunRecord
from orchestrate.runner.chunks import Chunks
from orchestrate.runner.progress import Tally
from orchestrate.runner.saving import RetryingStore
from orchestrate.store import Claim, InvalidResultError

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
        """Whether no further trial starts."""
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
            self.executor.submit(
                [self._sized(task) for task in mine if not self._give_up(task.key)]
            )

    def _sized(self, task: Task) -> Task:
        """Return the task with more memory if it has run out of memory here."""
        if self.retry_memory is None or task.key not in self._out_of_memory:
            return task
        return replace(task, memory_factor=self.retry_memory)

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
            self.failures[_summary(failure)] += 1
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
    message = f"{lost_part} {_times(times)} while running{only} this trial (last: {lost.reason})"
    cause = NODE_LOST if lost.node_lost else lost.cause
    return Failure("WorkerLost", message, lost.traceback, cause)


def _times(count: int) -> str:
    return {1: "once", 2: "twice"}.get(count, f"{count} times")


def _summary(failure: Failure) -> str:
    """Return the type and the first line of a failure."""
    first = next(iter(failure.message.splitlines()), "")
    return first if failure.cause == "timeout" else f"{failure.type}: {first}"


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
