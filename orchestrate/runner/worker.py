"""Worker: a launch that runs trials which other launches have registered, for a limited time."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from dopt.cores import usable_cores
from dopt.kernel import warm_up
from dopt.run import run_trial
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.config.value_checks import factor
from orchestrate.errors import ExitCode
from orchestrate.executors.registry import make_executor
from orchestrate.runner.progress import Progress, Tally
from orchestrate.runner.provenance import launch_record
from orchestrate.runner.retrying_store import RetryingStore
from orchestrate.runner.run_grid import Output, Work, prepare_workers, recorded_launch
from orchestrate.runner.scheduler import Scheduler
from orchestrate.runner.signals import SIGNALS, Interrupt, Repetition
from orchestrate.runner.stored_chunks import StoredChunks
from orchestrate.runner.summary import worked

ROOT = Path(__file__).resolve().parents[2]
WORK = Work(run_trial, warm_up)

WARNINGS = (*SIGNALS, signal.SIGUSR1)
"""Signals before a preemption; batch systems send SIGUSR1 when asked for a warning."""

FINISHING_SECONDS = 2.0
"""Time in which running trials may still finish after a warning."""

LEAVING_SECONDS = 5.0
"""Time before the end of the worker's time at which it hands back what it holds."""

POLL_SECONDS = 1.0
"""Least time between two looks for trials that other workers give back."""

NOTICE = "\nstopping: trials that do not finish within 2 s are handed back\n"


@dataclass(frozen=True)
class WorkerSettings:
    """Settings of a worker.

    Attributes
    ----------
    url
        Database, which exists.
    seconds
        Time after which nothing is held any more; None until no trial is left.
    processes
        Trials at once; None for one on each core that this process may use.
    timeout, memory_gib, retry_memory, lease
        As those of a launch (:class:`orchestrate.config.launch_settings.LaunchSettings`).

    Raises
    ------
    LaunchError
        If ``retry_memory`` raises no limit.
    """

    url: str
    seconds: float | None = None
    processes: int | None = None
    timeout: float | None = 3600.0
    memory_gib: float | None = None
    retry_memory: float | None = None
    lease: float = 60.0

    def __post_init__(self) -> None:
        factor("--retry-memory", self.retry_memory, "--memory-gib", self.memory_gib)

    @property
    def launch(self) -> LaunchSettings:
        """The settings of the launch that a worker is."""
        return LaunchSettings(
            executor="local",
            store_url=self.url,
            workers=self.processes or usable_cores(),
            timeout=self.timeout,
            memory_gib=self.memory_gib,
            retry_memory=self.retry_memory,
            lease=self.lease,
            patience=min(30.0, self.lease / 2),
        )


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
        """Whether running trials are handed back now."""
        now = time.monotonic()
        if self._interrupt.stop_requested:
            self._asked = min(self._asked, now)
        return now >= min(self._end, self._asked + FINISHING_SECONDS)

    @property
    def signalled(self) -> bool:
        return self._interrupt.stop_requested


def run_worker(settings: WorkerSettings, output: Output, work: Work | None = None) -> ExitCode:
    """Run pending trials of a database until none is left, the time is over or a signal comes.

    Raises
    ------
    StoreError, InfrastructureError
        As :func:`orchestrate.runner.run_grid.launch_grid`.
    """
    with _signals_interrupt():
        launch = settings.launch
        record = launch_record(sys.argv, [], ROOT)
        start = time.monotonic()
        return recorded_launch(
            launch,
            record,
            output.say,
            output.warn,
            lambda store: _work(store, settings, launch, work or WORK, output, start),
        )


@contextmanager
def _signals_interrupt() -> Iterator[None]:
    """Let a warning end the preparation, in which nothing is held, as Ctrl-C does."""
    repeated = Repetition()

    def interrupt(number: int, _: FrameType | None) -> None:
        if not repeated(number):
            raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in WARNINGS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _work(
    store: RetryingStore,
    settings: WorkerSettings,
    launch: LaunchSettings,
    work: Work,
    output: Output,
    start: float,
) -> ExitCode:
    store.alike = True
    length = _length(settings.seconds, start)
    slots = launch.workers or 1
    chunks = StoredChunks(store, launch.chunk_seconds, slots, length, output.warn)
    chunks.look()
    output.say(f"{chunks.waiting:,} trials wait, {slots} processes · {store.safe_url}")
    if chunks.compiled:
        prepare_workers(work.prepare, output.warn)
    tally = Tally(chunks.left)
    interrupt = Interrupt(WARNINGS, NOTICE, store.hurry)
    with make_executor(launch, work.run) as executor, interrupt:
        leave = Leave(interrupt, _length(settings.seconds, start))
        scheduler = Scheduler(
            store, executor, chunks, tally, leave, retry_memory=launch.retry_memory
        )
        with Progress(tally, output.progress) as progress:
            _pull(scheduler, chunks, leave, progress)
    store.release()  # a server may commit a claim after its connection broke
    chunks.look()
    output.say(worked(tally, scheduler, chunks.left, time.monotonic() - start))
    if not chunks.left:
        return ExitCode.SOME_FAILED if tally.failed else ExitCode.DONE
    return ExitCode.INTERRUPTED if leave.signalled else ExitCode.UNFINISHED


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
