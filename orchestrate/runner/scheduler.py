"""Scheduler of a launch: claims trials, submits them, and commits their outcomes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Protocol

from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.executors.base import Executor, TaskDone, WorkerLost
from orchestrate.records import Failure, RunRecord
from orchestrate.runner.batching import Chunks
from orchestrate.runner.progress import Tally
from orchestrate.runner.retrying_store import RetryingStore
from orchestrate.store import Claim, InvalidResultError

POLL_SECONDS = 0.2

MAX_WORKER_LOSSES = 2
"""Worker deaths while a trial runs alone after which the trial fails."""

MAX_NODE_LOSSES = 5
"""Losses of a whole node after which a trial that ran there fails."""


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
    failures
        Number of failures by cause.
    """

    store: RetryingStore
    executor: Executor
    chunks: Chunks
    tally: Tally
    stop: Stop
    fail_fast: bool = False
    owned_by_others: int = 0
    failures: Counter[str] = field(default_factory=Counter)
    _running: dict[str, tuple[Claim, TrialSpec]] = field(default_factory=dict)
    _crash_counts: Counter[str] = field(default_factory=Counter)
    _node_losses: Counter[str] = field(default_factory=Counter)

    def step(self) -> bool:
        """Submit waiting trials and commit finished ones; return False when none is left."""
        self._fill()
        if not self.executor.pending:
            return False
        events = self.executor.wait(POLL_SECONDS)
        self._commit([event for event in events if isinstance(event, TaskDone)])
        for event in events:
            if isinstance(event, WorkerLost):
                self._recover(event)
        return True

    @property
    def ending(self) -> bool:
        """Whether no further trial starts."""
        return self.stop.stop_requested or (self.fail_fast and bool(self.failures))

    def _fill(self) -> None:
        self.chunks.slots = self.executor.slots
        while not self.ending and len(self.chunks) and self.executor.pending < self._window:
            tasks = self.chunks.next()
            claims = self.store.claim([task.key for task in tasks])
            held = {claim.trial_key: claim for claim in claims}
            self.owned_by_others += len(tasks) - len(held)
            mine = [task for task in tasks if task.key in held]
            self._running |= {task.key: (held[task.key], task.spec) for task in mine}
            self.executor.submit(mine)

    @property
    def _window(self) -> int:
        return 2 * self.executor.slots

    def _commit(self, events: Sequence[TaskDone]) -> None:
        results: list[tuple[Claim, TrialResult, RunRecord]] = []
        for event in events:
            claim, trial = self._running.pop(event.key)
            self.chunks.observe(trial.config_key, event.run.wall_seconds)
            if isinstance(event.outcome, Failure):
                self._fail(claim, event.outcome, event.run)
            else:
                results.append((claim, event.outcome, event.run))
        if results:
            self._write(results)

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
        self.owned_by_others += written.count(False)
        for (_, result, _), accepted in zip(results, written, strict=True):
            self.tally.diverged += accepted and result.diverged
            self.tally.done += accepted and not result.diverged

    def _fail(self, claim: Claim, failure: Failure, run: RunRecord) -> None:
        if self.store.fail(claim, failure, run):
            self.tally.failed += 1
            self.failures[_summary(failure)] += 1
        else:
            self.owned_by_others += 1

    def _recover(self, lost: WorkerLost) -> None:
        """Queue lost trials again, each alone; fail those that were lost too often."""
        counts = self._node_losses if lost.node_lost else self._crash_counts
        if lost.node_lost or len(lost.keys) == 1:
            counts.update(lost.keys)
        limit = _max_losses(lost)
        again = [key for key in lost.keys if counts[key] < limit]
        held = {key: self._running.pop(key) for key in lost.keys}
        if again:
            self.store.release(again, _cause(lost))
            self.chunks.add((held[key][1] for key in again), alone=not lost.node_lost)
        for key in held.keys() - again:
            self._fail(held[key][0], _loss_failure(lost, limit), _last_run(lost))


def _max_losses(lost: WorkerLost) -> int:
    """Return the number of losses of this kind after which a trial fails."""
    if lost.node_lost:
        return MAX_NODE_LOSSES
    return 1 if lost.cause == "timeout" else MAX_WORKER_LOSSES


def _cause(lost: WorkerLost) -> str:
    return "node lost" if lost.node_lost else lost.cause


def _loss_failure(lost: WorkerLost, times: int) -> Failure:
    if lost.cause == "timeout":
        return Failure("TrialTimeoutError", lost.reason, lost.traceback, lost.cause)
    lost_part = "node was lost" if lost.node_lost else "worker died"
    message = f"{lost_part} {_times(times)} while running this trial (last: {lost.reason})"
    return Failure("WorkerLost", message, lost.traceback, _cause(lost))


def _times(count: int) -> str:
    return {1: "once", 2: "twice"}.get(count, f"{count} times")


def _summary(failure: Failure) -> str:
    """Return the type and the first line of a failure."""
    first = next(iter(failure.message.splitlines()), "")
    return first if failure.cause == "timeout" else f"{failure.type}: {first}"


def _last_run(lost: WorkerLost) -> RunRecord:
    """Return the record of a run that was not measured."""
    now = datetime.now(UTC)
    return RunRecord(lost.node, lost.pid, 0.0, 0.0, 0, now, now)
