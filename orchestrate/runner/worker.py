"""Worker: a launch that runs trials which other launches have registered, for a limited time.

It takes a few trials at a time from the database, the longest first, and none that may end after
its time.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from types import FrameType

from dopt.errors import DoptError
from dopt.process import usable_cores
from dopt.spec.config import TrialConfig, completed
from dopt.spec.trial import TrialSpec, stored_trial
from orchestrate.config import LaunchSettings, factor
from orchestrate.errors import ExitCode
from orchestrate.executors.base import Task, check_processes
from orchestrate.executors.limits import BYTES_PER_GIB
from orchestrate.fingerprint import differences, fingerprint
from orchestrate.program import ROOT
from orchestrate.runner.progress import SIGNALS, Interrupt, Progress, Repetition, Tally, handling
from orchestrate.runner.saving import Patience, RetryingStore, launch_record
from orchestrate.runner.scheduler import (
    MAX_CHUNK_TRIALS,
    SUSPECT_LOSSES,
    Chunks,
    Scheduler,
    memory_of_this_machine,
)
from orchestrate.runner.start import WORK, Output, Work, recorded_launch, started, worked
from orchestrate.store import OpenConfig, Reader

WARNINGS = (*SIGNALS, signal.SIGUSR1)
"""Signals before a preemption; batch systems send SIGUSR1 when asked for a warning."""

FINISHING_SECONDS = 2.0
"""Time in which running trials may still finish after a warning."""

LEAVING_SECONDS = 5.0
"""Time before the end of the worker's time at which it hands back what it holds."""

POLL_SECONDS = 1.0
"""Least time between two looks for trials that other workers give back."""

NOTICE = "\nstopping: trials that do not finish within 2 s are handed back\n"


class Leave:
    """Reason to start no further trial, a signal or the end of the time; and when to go at once."""

    def __init__(self, interrupt: Interrupt, seconds: float | None) -> None:
        self._interrupt = interrupt
        self._end = float("inf") if seconds is None else time.monotonic() + seconds
        self._asked = float("inf")

    @property
    def stop_requested(self) -> bool:
        return self._interrupt.stop_requested or time.monotonic() >= self._end

    @property
    def at_once(self) -> bool:
        """Return whether running trials are handed back now."""
        now = time.monotonic()
        if self._interrupt.stop_requested:
            self._asked = min(self._asked, now)
        return now >= min(self._end, self._asked + FINISHING_SECONDS)


def run_worker(
    url: str,
    output: Output,
    work: Work | None = None,
    *,
    seconds: float | None = None,
    processes: int | None = None,
    timeout: float | None = 3600.0,
    memory_gib: float | None = None,
    retry_memory: float | None = None,
    lease: float = 60.0,
) -> ExitCode:
    """Run pending trials of a database until none is left, the time is over or a signal comes.

    Parameters
    ----------
    url
        Database, which has to exist.
    output, work
        Destinations of messages, and functions that run a trial and prepare for it, by default
        :data:`orchestrate.runner.start.WORK`.
    seconds
        Time after which nothing is held any more; None until no trial is left.
    processes
        Trials at once; None for one on each core that this process may use.
    timeout, memory_gib, retry_memory, lease
        As in :class:`orchestrate.config.LaunchSettings`.

    Raises
    ------
    LaunchError
        If ``retry_memory`` raises no limit, or no machine can start so many processes.
    StoreError, InfrastructureError
        As :func:`orchestrate.runner.start.launch_grid`.
    """
    settings = LaunchSettings(
        executor="local",
        store_url=url,
        workers=processes or usable_cores(),
        timeout=timeout,
        memory_gib=memory_gib,
        retry_memory=factor("--retry-memory", retry_memory, "--memory-gib", memory_gib),
        lease=lease,
        patience=min(30.0, lease / 2),
    )
    check_processes(settings)
    repeated = Repetition()

    def interrupt(number: int, _: FrameType | None) -> None:
        if not repeated(number):
            raise KeyboardInterrupt

    with handling(WARNINGS, interrupt):  # as Ctrl-C until trials are claimed
        record = launch_record(sys.argv, [], ROOT)
        start = time.monotonic()
        patience = Patience(settings.patience, output.warn)
        patience(lambda: Reader.open(url).close())  # a worker creates no database
        return recorded_launch(
            settings,
            record,
            output,
            lambda store: _work(store, settings, seconds, work or WORK, output, start),
        )


def _work(
    store: RetryingStore,
    settings: LaunchSettings,
    seconds: float | None,
    work: Work,
    output: Output,
    start: float,
) -> ExitCode:
    store.alike = True
    length = _length(seconds, start)
    slots = settings.workers or 1
    chunks = StoredChunks(store, settings.chunk_seconds, slots, length, output.warn)
    chunks.look()
    processes = f"{slots} process{'es' * (slots > 1)}"
    output.say(f"{chunks.waiting:,} trials wait, {processes} · {store.safe_url}")
    tally = Tally(chunks.left)
    interrupt = Interrupt(WARNINGS, NOTICE, store.hurry)
    with started(settings, work, chunks.configs, output.warn) as executor, interrupt:
        leave = Leave(interrupt, _length(seconds, start))
        scheduler = Scheduler(
            store, executor, chunks, tally, leave, retry_memory=settings.retry_memory
        )
        with Progress(tally, output.progress) as progress:
            _pull(scheduler, chunks, leave, progress)
    store.release()  # a server may commit a claim after its connection broke
    chunks.look()
    output.say(worked(tally, scheduler, chunks.left, time.monotonic() - start))
    if not chunks.left:
        return ExitCode.SOME_FAILED if tally.failed else ExitCode.DONE
    return ExitCode.INTERRUPTED if interrupt.stop_requested else ExitCode.UNFINISHED


def _length(seconds: float | None, start: float) -> float | None:
    """Return the time from now to the moment at which the worker leaves."""
    if seconds is None:
        return None
    return start + seconds - min(LEAVING_SECONDS, 0.1 * seconds) - time.monotonic()


def _pull(scheduler: Scheduler, chunks: StoredChunks, leave: Leave, progress: Progress) -> None:
    """Run trials until none can be claimed any more; wait for those that others may give back."""
    pause = 0.0
    while not leave.at_once:
        if scheduler.step():
            scheduler.tally.total = scheduler.tally.over + chunks.left
            progress.update()
            pause = 0.0
            continue
        time.sleep(pause)
        start = time.monotonic()
        chunks.look()
        chunks.look_for_suspects()
        if leave.stop_requested or not chunks.left_here or (chunks.waiting and not len(chunks)):
            return
        pause = max(POLL_SECONDS, 5 * (time.monotonic() - start))


REFRESH_SECONDS = 5.0
"""Least time between two looks at all configurations; a look may take a twentieth of it."""

MARGIN = 1.5
"""Factor of the longest measured trial of a configuration that bounds the next one."""

UNKNOWN_SHARE = 0.5
"""Share of the worker's whole time that a trial of a configuration without a measured one gets."""


class StoredChunks(Chunks):
    """Queue whose trials are pending in the database, where other workers take them too.

    Parameters
    ----------
    store : RetryingStore
    seconds : float
        Work in a chunk [s].
    slots : int
        Processes of this worker.
    length : float or None
        Time of the worker [s]; None for no limit. No chunk is returned that may end after it.
    warn
        Takes a sentence for each configuration that cannot run here.

    Attributes
    ----------
    left : int
        Trials of the database without an outcome, as of the last look.
    left_here : int
        The ones among them that this worker can run, or could if another worker gave them back.
    """

    def __init__(
        self,
        store: RetryingStore,
        seconds: float,
        slots: int,
        length: float | None,
        warn: Callable[[str], None],
    ) -> None:
        super().__init__([], seconds, slots)
        self.left = self.left_here = 0
        self._store = store
        self._length = length
        self._end = None if length is None else time.monotonic() + length
        self._warn = warn
        self._kinds: dict[str, OpenConfig] = {}
        self._firsts: dict[str, TrialSpec] = {}  # the trial with seed 0 of each
        self._refused: set[str] = set()
        self._left: set[str] = set()
        self._submitted: deque[float] = deque(maxlen=2 * slots)
        self._next_look = 0.0

    def look(self) -> None:
        """Read the configurations that have open trials, after freeing trials of dead launches."""
        start = time.monotonic()
        self._store.recover()
        open_configs = self._store.open_configs()
        self._kinds = {one.config_key: one for one in open_configs if self._runs_here(one)}
        counts = {config.config_key: config.pending + config.running for config in open_configs}
        self.left = sum(counts.values()) + self._count_others()
        self.left_here = sum(counts[key] for key in self._kinds)
        now = time.monotonic()
        self._next_look = now + max(REFRESH_SECONDS, 20 * (now - start))

    def _count_others(self) -> int:
        """Return the open trials of other code, and say once what differs."""
        others = self._store.others()
        for theirs, count in others:
            if str(theirs) not in self._left:
                self._left.add(str(theirs))
                known = differences(theirs, fingerprint()) if theirs else "an older program"
                self._warn(
                    f"{count:,} trials are left, which other code has registered ({known}): run a "
                    "worker with that code, or give their launch command again with this code."
                )
        return sum(count for _, count in others)

    def look_for_suspects(self) -> None:
        """Queue the trials whose launches were lost too often; call it while no trial runs."""
        self._exclusive.clear()
        by_id = {kind.config_id: kind for kind in self._kinds.values()}
        for trial in self._store.suspects(SUSPECT_LOSSES):
            if trial.config_id in by_id and self._room(by_id[trial.config_id]):
                self.lone_losses[trial.trial_key] = trial.lone_losses
                first = self._firsts[by_id[trial.config_id].config_key]
                self.add_exclusive([first.with_seed(trial.seed)])

    @property
    def configs(self) -> list[TrialConfig]:
        """Configurations that have open trials and can run here."""
        return [self._firsts[key].config for key in self._kinds]

    @property
    def waiting(self) -> int:
        """Pending trials that this worker could run if it had the time."""
        return sum(kind.pending for kind in self._kinds.values())

    def __len__(self) -> int:
        if self.pending and self._exclusive_runs:
            return 0
        if time.monotonic() > self._next_look:
            self.look()
        return super().__len__() or int(any(True for _ in self._candidates()))

    def observe(self, config_key: str, seconds: float) -> None:
        super().observe(config_key, seconds)
        self.left -= 1
        self.left_here -= 1
        if kind := self._kinds.get(config_key):
            kind.mean_seconds = self._costs[config_key]
            kind.max_seconds = max(seconds, kind.max_seconds or 0.0)

    def next(self) -> list[Task]:
        """Return trials to claim: some of them may be gone by then; none if nothing fits."""
        if chunk := self._fitting(self._alone):
            return chunk
        for kind in list(self._candidates()):
            if chunk := self._take(kind):
                self._exclusive_runs = False
                return self._given(kind, chunk)
        return self._fitting(self._exclusive)

    def _fitting(self, queue: deque[TrialSpec]) -> list[Task]:
        """Return the first trial of a queue that ends in time; the others are left to the store."""
        while queue:
            chunk = super().next()
            kind = self._kinds.get(chunk[0].spec.config_key)
            if kind is not None and self._room(kind):
                return self._given(kind, chunk)
        return []

    def _given(self, kind: OpenConfig, chunk: list[Task]) -> list[Task]:
        self._submitted.append(len(chunk) * self._bound(kind))
        return chunk

    def _take(self, kind: OpenConfig) -> list[Task]:
        """Return pending trials of a configuration, and queue those that killed a process."""
        size = self._size(kind)
        found = self._store.open_trials(kind.config_id, size, SUSPECT_LOSSES)
        kind.pending = max(0, kind.pending - len(found)) if len(found) == size else 0
        first = self._firsts[kind.config_key]
        specs = [(trial, first.with_seed(trial.seed)) for trial in found]
        self.add((spec for trial, spec in specs if trial.crashes), alone=True)
        chunk = [Task(spec.trial_key, spec) for trial, spec in specs if not trial.crashes]
        return chunk or (super().next() if self._alone else [])

    def _candidates(self) -> Iterator[OpenConfig]:
        """Yield the configurations of which a trial fits, the longest first, unknown ones before.

        A long trial that starts last would keep one process busy while the others have nothing.
        """
        waiting = (kind for kind in self._kinds.values() if kind.pending)
        ordered = sorted(waiting, key=lambda kind: -(kind.mean_seconds or float("inf")))
        return (kind for kind in ordered if self._room(kind))

    def _size(self, kind: OpenConfig) -> int:
        if kind.mean_seconds is None:
            return 1
        most = min(MAX_CHUNK_TRIALS, max(1, kind.pending // (2 * self.slots)), self._room(kind))
        return max(1, min(most, int(self._seconds / max(kind.mean_seconds, 1e-9))))

    def _room(self, kind: OpenConfig) -> int:
        """Return how many trials of a configuration, one after the other, end in time."""
        if self._end is None:
            return MAX_CHUNK_TRIALS
        # A process holds at most one chunk before the new one.
        before = max(self._submitted, default=0.0) if self.pending >= self.slots else 0.0
        seconds = self._end - time.monotonic() - before
        return max(0, min(MAX_CHUNK_TRIALS, int(seconds / max(self._bound(kind), 1e-9))))

    def _bound(self, kind: OpenConfig) -> float:
        """Return the time [s] that a trial of a configuration is assumed to take at most."""
        if kind.max_seconds is not None:
            return MARGIN * kind.max_seconds
        return UNKNOWN_SHARE * (self._length or 0.0)

    def _runs_here(self, config: OpenConfig) -> bool:
        """Return whether this process can build a configuration; take over what it measured."""
        key = config.config_key
        if key in self._refused:
            return False
        try:
            self._firsts[key] = self._firsts.get(key) or trial_of(config, self.slots)
        except DoptError as error:
            self._refused.add(key)
            self._warn(f"{config.pending:,} trials are left to other workers: {error}")
            return False
        longest = (one.max_seconds or 0.0 for one in (config, self._kinds.get(key, config)))
        config.mean_seconds = self._costs.get(key, config.mean_seconds)
        config.max_seconds = max(longest) or None
        return True


def trial_of(config: OpenConfig, at_once: int) -> TrialSpec:
    """Return the trial with seed 0 of a stored configuration.

    Raises
    ------
    DoptError
        If the code of this machine builds another trial from it or lacks a part of it, or if its
        memory does not hold ``at_once`` of them.
    """
    spec = stored_trial(completed(json.loads(config.config_json)))
    if spec.config_key != config.config_key:
        raise DoptError(
            f"Configuration {config.config_key[:12]} was registered by another version of the "
            f"code, in which it has other numbers: run the worker with that version."
        )
    available = memory_of_this_machine()
    if at_once * spec.config.memory > available:
        raise DoptError(
            f"{at_once} trials of env={spec.system.name} policy={spec.policy.name} need "
            f"{at_once * spec.config.memory / BYTES_PER_GIB:.3g} GiB of memory, but this machine "
            f"has {available / BYTES_PER_GIB:.3g} GiB: give a lower --processes."
        )
    return spec
