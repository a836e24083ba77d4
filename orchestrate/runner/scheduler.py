"""The loop of a launch: claim, hand out, commit. The one place that writes outcomes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Protocol

from dopt.result import TrialResult
from dopt.spec import TrialSpec
from orchestrate.chunks import Chunks
from orchestrate.executors.base import Executor, Finished, Lost, Trouble
from orchestrate.patience import PatientStore
from orchestrate.progress import Tally
from orchestrate.store import Claim, Failure, InvalidResultError, RunRecord

POLL_SECONDS = 0.2

ATTEMPTS = 2
"""Times that a trial may end its worker while it runs alone."""

NODE_LOSSES = 5
"""Times that a trial may be lost together with a whole node."""


class Stop(Protocol):
    """Says whether nothing more should start."""

    @property
    def draining(self) -> bool: ...


@dataclass
class Driver:
    """Runs the waiting trials of one launch.

    Attributes
    ----------
    elsewhere
        Number of trials that turned out to be another launch's.
    failures
        How often each cause of failure was met.
    """

    store: PatientStore
    executor: Executor
    chunks: Chunks
    tally: Tally
    stop: Stop
    fail_fast: bool = False
    elsewhere: int = 0
    failures: Counter[str] = field(default_factory=Counter)
    _running: dict[str, tuple[Claim, TrialSpec]] = field(default_factory=dict)
    _strikes: Counter[str] = field(default_factory=Counter)
    _node_losses: Counter[str] = field(default_factory=Counter)

    def step(self) -> bool:
        """Hand out what there is room for and commit what has ended; False when nothing is left."""
        self._fill()
        if not self.executor.pending:
            return False
        events = self.executor.wait(POLL_SECONDS)
        self._commit([event for event in events if isinstance(event, Finished)])
        for event in events:
            if isinstance(event, Lost):
                self._recover(event)
        return True

    @property
    def ending(self) -> bool:
        """Whether no further trial starts."""
        return self.stop.draining or (self.fail_fast and bool(self.failures))

    def _fill(self) -> None:
        self.chunks.slots = self.executor.slots
        while not self.ending and len(self.chunks) and self.executor.pending < self._window:
            tasks = self.chunks.next()
            claims = self.store.claim([task.key for task in tasks])
            held = {claim.trial_key: claim for claim in claims}
            self.elsewhere += len(tasks) - len(held)
            mine = [task for task in tasks if task.key in held]
            self._running |= {task.key: (held[task.key], task.spec) for task in mine}
            self.executor.submit(mine)

    @property
    def _window(self) -> int:
        return 2 * self.executor.slots

    def _commit(self, events: Sequence[Finished]) -> None:
        results: list[tuple[Claim, TrialResult, RunRecord]] = []
        for event in events:
            claim, trial = self._running.pop(event.key)
            self.chunks.observe(trial.config_key, event.usage.wall_seconds)
            run = RunRecord(**vars(event.usage))
            if isinstance(event.outcome, Trouble):
                self._fail(claim, Failure(**vars(event.outcome)), run)
            else:
                results.append((claim, event.outcome, run))
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
        self.elsewhere += written.count(False)
        for (_, result, _), accepted in zip(results, written, strict=True):
            self.tally.diverged += accepted and result.diverged
            self.tally.done += accepted and not result.diverged

    def _fail(self, claim: Claim, failure: Failure, run: RunRecord) -> None:
        if self.store.fail(claim, failure, run):
            self.tally.failed += 1
            self.failures[_words(failure)] += 1
        else:
            self.elsewhere += 1

    def _recover(self, lost: Lost) -> None:
        """Let lost trials wait again, each alone, but for one that was lost too often."""
        counts = self._node_losses if lost.blameless else self._strikes
        if lost.blameless or len(lost.keys) == 1:
            counts.update(lost.keys)
        limit = _limit(lost)
        again = [key for key in lost.keys if counts[key] < limit]
        held = {key: self._running.pop(key) for key in lost.keys}
        if again:
            self.store.release(again, _cause(lost))
            self.chunks.add((held[key][1] for key in again), alone=not lost.blameless)
        for key in held.keys() - again:
            self._fail(held[key][0], _death(lost, limit), _last_run(lost))


def _limit(lost: Lost) -> int:
    """Return how often a trial may be lost in this way."""
    if lost.blameless:
        return NODE_LOSSES
    return 1 if lost.cause == "timeout" else ATTEMPTS


def _cause(lost: Lost) -> str:
    return "node lost" if lost.blameless else lost.cause


def _death(lost: Lost, times: int) -> Failure:
    if lost.cause == "timeout":
        return Failure("TrialTimeoutError", lost.reason, lost.traceback, lost.cause)
    place = "with its node" if lost.blameless else "alone on its worker"
    message = f"lost {times} times {place}, which has {lost.reason} the last time"
    return Failure("WorkerLost", message, lost.traceback, _cause(lost))


def _words(failure: Failure) -> str:
    """Return the kind of a failure in one line."""
    first = next(iter(failure.message.splitlines()), "")
    return first if failure.cause == "timeout" else f"{failure.type}: {first}"


def _last_run(lost: Lost) -> RunRecord:
    """Return what is known of a run that could not be measured."""
    now = datetime.now(UTC)
    return RunRecord(lost.node, lost.pid, 0.0, 0.0, 0, now, now)
