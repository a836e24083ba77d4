"""One launch from its grid to its exit code: register, run what is not done, sum up."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TextIO

from dopt.errors import DoptError
from dopt.spec import TrialSpec
from orchestrate.chunks import Chunks
from orchestrate.driver import Driver
from orchestrate.errors import ExitCode, InfrastructureError
from orchestrate.executors import check_executor, make_executor
from orchestrate.executors.base import Run
from orchestrate.grid import Grid
from orchestrate.heartbeat import Heartbeat
from orchestrate.interrupt import Interrupt
from orchestrate.patience import PatientStore
from orchestrate.progress import Progress, Tally
from orchestrate.settings import LaunchSettings
from orchestrate.store import LaunchRecord, Registration, Store, StoreUnavailableError
from orchestrate.summary import closing, opening

OTHERS_SECONDS = 1.0
"""Time between two looks at trials that another launch runs."""

SILENT_SECONDS = 3.0
"""What takes longer is announced."""

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
    warn: Say | None = None,
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
    warn
        Takes why the launch waits; by default ``say``.

    Raises
    ------
    LaunchError
        If nothing can run as the settings ask; then nothing is written.
    StoreError, InfrastructureError
        If the database or the workers fail; nothing that was committed is lost.
    """
    check_executor(settings)
    with Store.open(settings.store_url, lease_seconds=settings.lease) as store:
        launch = store.begin_launch(record)
        try:
            with Heartbeat(store, launch, settings.lease):
                patient = PatientStore(store, launch, settings.patience, warn or say)
                code = _interruptible(patient, grid, settings, work, say, stream)
                patient.end(_STATES.get(code, "failed"), code)
        except BaseException as error:
            # One more try to free the claims; what is wrong is said by the error that is raised.
            with suppress(StoreUnavailableError):
                store.end_launch(launch, "failed", _code_of(error))
            raise
    return code


_STATES = {ExitCode.DONE: "done", ExitCode.INTERRUPTED: "interrupted"}


def _code_of(error: BaseException) -> ExitCode | None:
    """Return what the shell will be told, None where the process is told to end."""
    if isinstance(error, StoreUnavailableError | InfrastructureError):
        return ExitCode.INFRASTRUCTURE
    if isinstance(error, DoptError):
        return ExitCode.BAD_REQUEST
    return ExitCode.DEFECT if isinstance(error, Exception) else None


def _interruptible(
    store: PatientStore,
    grid: Grid,
    settings: LaunchSettings,
    work: Work,
    say: Say,
    stream: TextIO | None,
) -> ExitCode:
    try:
        return _run(store, grid, settings, work, say, stream)
    except KeyboardInterrupt:
        say("stopped: what was committed is kept, the same command goes on from here")
        return ExitCode.INTERRUPTED


def _run(
    store: PatientStore,
    grid: Grid,
    settings: LaunchSettings,
    work: Work,
    say: Say,
    stream: TextIO | None,
) -> ExitCode:
    store.recover()
    if settings.retry:
        store.retry(settings.retry, [trial.trial_key for trial in grid.trials])
    state = store.register(grid.trials)
    tally = Tally(state.total)
    _count(tally, state)
    say(opening(grid, state, settings, store.safe_url))
    if tally.left:
        compiled = any(trial.cell.path == "kernel" for trial in grid.trials)
        prepare = work.prepare if compiled else None
        if prepare:
            with _said_if_slow("compiling the kernel, which is kept for later launches", say):
                prepare()
        start = time.monotonic()
        with make_executor(settings, work.run, prepare) as executor, Interrupt() as stop:
            waiting = _waiting(grid, state)
            chunks = Chunks(waiting, settings.chunk_seconds, executor.slots, executor.batch)
            driver = Driver(store, executor, chunks, tally, stop, settings.fail_fast)
            driver.elsewhere = state.running_elsewhere
            with Progress(tally, stream) as progress:
                _drive(driver, grid, progress)
        say(closing(tally, driver.failures, stop.draining, time.monotonic() - start))
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
    pause = 0.0
    while True:
        worked = False
        while driver.step():
            worked = True
            progress.update()
        if driver.ending or not driver.elsewhere:
            return
        if not worked:
            time.sleep(pause)
        pause = _look_at_others(driver, grid)
        progress.update()


def _look_at_others(driver: Driver, grid: Grid) -> float:
    """Count what other launches have finished, and take the trials that they have given up.

    Returns the seconds before another look, where this one has found nothing to run.
    """
    start = time.monotonic()
    driver.store.recover()
    driver.store.release_forgotten()
    state = driver.store.register(grid.trials)
    _count(driver.tally, state)
    driver.elsewhere = state.running_elsewhere
    driver.chunks.add(_waiting(grid, state))
    return max(OTHERS_SECONDS, 5 * (time.monotonic() - start))


def _waiting(grid: Grid, state: Registration) -> list[TrialSpec]:
    trials = {trial.trial_key: trial for trial in grid.trials}
    return [trials[key] for key in state.todo]


def _count(tally: Tally, state: Registration) -> None:
    """Let the tally hold what the database says of the trials that are not of this launch."""
    tally.before = state.done + state.diverged + state.failed + state.cancelled - tally.over
    tally.failed_before = state.failed + state.cancelled - tally.failed
