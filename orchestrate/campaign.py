"""One launch from its grid to its exit code: register, run what is not done, sum up."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TextIO

from dopt.spec import TrialSpec
from orchestrate.chunks import Chunks
from orchestrate.driver import Driver
from orchestrate.errors import ExitCode
from orchestrate.executors import make_executor
from orchestrate.executors.base import Run
from orchestrate.grid import Grid
from orchestrate.interrupt import Interrupt
from orchestrate.progress import Progress, Tally, duration
from orchestrate.settings import LaunchSettings
from orchestrate.store import LaunchRecord, Registration, Store

OTHERS_SECONDS = 1.0
"""Time between two looks at trials that another launch runs."""

SILENT_SECONDS = 3.0
"""What takes longer is announced."""

SHOWN_CAUSES = 3
"""Causes of failure that are named at the end."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class Work:
    """What is done with a trial, and what is done once before the first one."""

    run: Run
    prepare: Callable[[], None]


def launch_grid(
    grid: Grid,
    settings: LaunchSettings,
    record: LaunchRecord,
    work: Work,
    say: Say,
    stream: TextIO | None = sys.stderr,
) -> ExitCode:
    """Bring every trial of the grid to an outcome.

    Parameters
    ----------
    grid, settings
        What to run, and how.
    record
        Provenance of the command.
    work
        What a trial is.
    say
        Takes what there is to tell at the beginning and at the end.
    stream
        Where the progress goes, or None for none.

    Raises
    ------
    StoreError, InfrastructureError
        If the database or the workers fail; nothing that was committed is lost.
    """
    with Store.open(settings.store_url) as store:
        store.recover()
        launch = store.begin_launch(record)
        code = ExitCode.INFRASTRUCTURE
        try:
            code = _run(store, launch, grid, settings, work, say, stream)
        except KeyboardInterrupt:
            say("stopped: what was committed is kept, the same command goes on from here")
            code = ExitCode.INTERRUPTED
        finally:
            store.end_launch(launch, _STATES.get(code, "failed"))
    return code


_STATES = {ExitCode.DONE: "done", ExitCode.INTERRUPTED: "interrupted"}


def _run(
    store: Store,
    launch: int,
    grid: Grid,
    settings: LaunchSettings,
    work: Work,
    say: Say,
    stream: TextIO | None,
) -> ExitCode:
    if settings.retry:
        store.retry(settings.retry, [trial.trial_key for trial in grid.trials])
    state = store.register(launch, grid.trials)
    tally = Tally(state.total)
    _count(tally, state)
    say(_opening(grid, state, settings, store.safe_url))
    if tally.left:
        if settings.path == "kernel":
            with _said_if_slow("compiling the kernel, which is kept for later launches", say):
                work.prepare()
        start = time.monotonic()
        with make_executor(settings, work.run) as executor, Interrupt() as stop:
            waiting = _waiting(grid, state)
            chunks = Chunks(waiting, settings.chunk_seconds, executor.slots, executor.batch)
            driver = Driver(store, launch, executor, chunks, tally, stop, settings.fail_fast)
            driver.elsewhere = state.running_elsewhere
            with Progress(tally, stream) as progress:
                _drive(driver, grid, progress)
        say(_closing(tally, driver, time.monotonic() - start))
        if stop.draining and tally.left:
            return ExitCode.INTERRUPTED
    return ExitCode.SOME_FAILED if tally.all_failed else ExitCode.DONE


@contextmanager
def _said_if_slow(text: str, say: Say) -> Iterator[None]:
    timer = threading.Timer(SILENT_SECONDS, say, [text])
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _drive(driver: Driver, grid: Grid, progress: Progress) -> None:
    """Run until every trial has an outcome, also those that another launch had taken."""
    while True:
        while driver.step():
            progress.update()
        if driver.ending or not driver.elsewhere:
            return
        _look_at_others(driver, grid)
        progress.update()


def _look_at_others(driver: Driver, grid: Grid) -> None:
    """Count what other launches have finished, and take the trials that they have given up."""
    start = time.monotonic()
    driver.store.recover()
    state = driver.store.register(driver.launch, grid.trials)
    _count(driver.tally, state)
    driver.elsewhere = state.running_elsewhere
    driver.chunks.add(_waiting(grid, state))
    if not state.todo and driver.elsewhere:
        time.sleep(max(OTHERS_SECONDS, 5 * (time.monotonic() - start)))


def _waiting(grid: Grid, state: Registration) -> list[TrialSpec]:
    trials = {trial.trial_key: trial for trial in grid.trials}
    return [trials[key] for key in state.todo]


def _count(tally: Tally, state: Registration) -> None:
    """Let the tally hold what the database says of the trials that are not of this launch."""
    tally.before = state.done + state.diverged + state.failed + state.cancelled - tally.over
    tally.failed_before = state.failed + state.cancelled - tally.failed


def _opening(grid: Grid, state: Registration, settings: LaunchSettings, url: str) -> str:
    lines = [f"left out {count:,} trials: {reason}" for reason, count in grid.left_out.items()]
    if grid.repeats:
        lines.append(f"{grid.repeats:,} of {grid.asked:,} jobs name a trial of the grid again")
    counted = f"{state.done + state.diverged:,} of {state.total:,} already done"
    if state.failed:
        counted += f", {state.failed:,} failed before (launch.retry=failed runs them again)"
    if state.running_elsewhere:
        counted += f", {state.running_elsewhere:,} running in another launch"
    todo = f"{len(state.todo):,} to run with executor={settings.executor}"
    lines.append(f"{counted}, {todo if state.todo else 'nothing to run'} · {url}")
    return "\n".join(lines)


def _closing(tally: Tally, driver: Driver, seconds: float) -> str:
    lines = [
        f"{tally.total - tally.left - tally.all_failed:,} of {tally.total:,} done, "
        f"{tally.all_failed:,} failed, {tally.diverged:,} diverged now, in {duration(seconds)}"
    ]
    for cause, count in driver.failures.most_common(SHOWN_CAUSES):
        lines.append(f"{count:,} failed with {cause}")
    if tally.left:
        why = "interrupted" if driver.stop.draining else "stopped at the first failure"
        lines.append(f"{why}, {tally.left:,} left: the same command goes on from here")
    return "\n".join(lines)
