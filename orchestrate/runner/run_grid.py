"""Execution of a grid: registration, stages, copies of a share, and what a launch says of it."""

from __future__ import annotations

import itertools
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from typing import TextIO

from dopt.kernel import compiling, kinds_of
from dopt.run import run_trial
from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec
from orchestrate.config import Grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.errors import ExitCode
from orchestrate.executors.base import Executor, Job, Run, executor_factory, make_executor, make_job
from orchestrate.program import exit_code
from orchestrate.runner.progress import Interrupt, Progress, Tally, duration
from orchestrate.runner.saving import Heartbeat, RetryingStore
from orchestrate.runner.scheduler import Chunks, Scheduler, SeedPlan
from orchestrate.store import (
    URL_VARIABLE,
    DatabaseMovedError,
    LaunchRecord,
    Registration,
    Store,
    StoreError,
    StoreUnavailableError,
)
from orchestrate.store.maintenance import collect, merge_collected

POLL_OTHER_LAUNCHES_SECONDS = 1.0
"""Interval of status queries for trials that another launch runs."""

ANNOUNCE_AFTER_SECONDS = 1.0
"""Duration of a preparation after which a message explains the delay."""

STOPPED = "stopped: committed trials are kept; run the same command again to continue"
COMPILING = "compiling the kernel: this takes up to a minute, and later launches reuse it"

Say = Callable[[str], None]


Preparation = Callable[[Sequence[TrialConfig]], AbstractContextManager[object]]
"""Takes configurations of the kernel, one of each kind; a context manager, which prepares for their
trials while its block runs and has done so at the block's end."""


@dataclass(frozen=True)
class Work:
    """Function that runs a trial, and what prepares a machine for trials."""

    run: Run
    prepare: Preparation = nullcontext


WORK = Work(run_trial, compiling)
"""Functions of a real launch."""


@dataclass(frozen=True)
class Output:
    """Destinations of the messages of a launch: summary, delays, and progress lines."""

    say: Say
    warn: Say
    progress: TextIO | None


def launch_grid(
    grid: Grid,
    settings: LaunchSettings,
    record: LaunchRecord,
    work: Work,
    say: Say,
    stream: TextIO | None = None,
    warn: Say | None = None,
) -> ExitCode:
    """Bring every trial of the grid to an outcome, or leave that to workers.

    Parameters
    ----------
    grid, settings
        Trials to run, and the settings of the launch.
    record
        Provenance of the command.
    work
        Functions that run a trial and prepare for it.
    say
        Takes the summary lines at the beginning and at the end.
    stream
        Destination of progress lines, or None for none.
    warn
        Takes messages about delays; by default ``say``.

    Raises
    ------
    LaunchError
        If nothing can run as the settings ask; then nothing is written.
    StoreError, InfrastructureError
        If the database or the workers fail; nothing that was committed is lost.
    """
    output = Output(say, warn or say, stream)
    if not settings.detach:
        executor_factory(settings).check(settings)
    job = make_job(settings)

    def body(store: RetryingStore) -> ExitCode:
        if settings.detach or job is not None:
            return leave(store, grid, settings, job, say)
        return _run(store, grid, settings, work, output)

    return recorded_launch(settings, record, output, body)


def recorded_launch(
    settings: LaunchSettings,
    record: LaunchRecord,
    output: Output,
    body: Callable[[RetryingStore], ExitCode],
) -> ExitCode:
    """Run ``body`` as a launch that the database records, alive until it ends.

    Raises
    ------
    StoreError, InfrastructureError
        If the database or the workers fail; claims are released if that is possible.
    """
    opened = Store.open(settings.store_url, settings.lease, settings.patience)
    with collected(settings, output.warn), opened as store:
        launch = store.begin_launch(record)
        try:
            with Heartbeat(store, launch, settings.lease):
                patient = RetryingStore(store, launch, settings.patience, output.warn)
                try:
                    code = body(patient)
                except KeyboardInterrupt:
                    output.say(STOPPED)
                    code = ExitCode.INTERRUPTED
                patient.end_launch(_STATES.get(code, "failed"), code)
        except BaseException as error:
            # Try once more to release the claims; the error itself is reported by the caller.
            with suppress(StoreUnavailableError):
                known = exit_code(error) if isinstance(error, Exception) else None
                store.end_launch(launch, "failed", known)
            raise
    return code


_STATES = {
    ExitCode.DONE: "done",
    ExitCode.INTERRUPTED: "interrupted",
    ExitCode.UNFINISHED: "interrupted",
}


def _run(
    store: RetryingStore,
    grid: Grid,
    settings: LaunchSettings,
    work: Work,
    output: Output,
) -> ExitCode:
    free_trials(store, grid, settings)
    plan, tally = SeedPlan(grid, settings.until), Tally(0)
    stages = _open_stages(store, plan, tally, settings, output.say)
    first = next(stages, None)
    if first is not None:
        open_stages = itertools.chain([first], stages)
        if _run_stages(open_stages, store, grid, tally, settings, work, output):
            return ExitCode.INTERRUPTED
    if plan.adaptive and not tally.left:
        output.say(plan.report())
    return ExitCode.SOME_FAILED if tally.all_failed else ExitCode.DONE


def _open_stages(
    store: RetryingStore, plan: SeedPlan, tally: Tally, settings: LaunchSettings, say: Say
) -> Iterator[tuple[Grid, Registration]]:
    """Register the stages of a launch one after the other; yield those with trials to run."""
    for heading, stage in plan.stages(store.final_losses):
        state = store.register(stage.trials)
        tally.total = state.total
        _count(tally, state)
        say(opening(stage, state, settings, store.safe_url, heading))
        if tally.left:
            yield stage, state


def _run_stages(
    stages: Iterable[tuple[Grid, Registration]],
    store: RetryingStore,
    grid: Grid,
    tally: Tally,
    settings: LaunchSettings,
    work: Work,
    output: Output,
) -> bool:
    """Run the stages with one executor; return whether an interrupt left trials of them."""
    configs = {trial.config_key: trial.config for trial in grid.trials}
    with started(settings, work, configs.values(), output.warn) as executor, Interrupt() as stop:
        start = time.monotonic()
        chunks = Chunks([], settings.chunk_seconds, executor.slots, executor.batch)
        scheduler = Scheduler(
            store, executor, chunks, tally, stop, settings.fail_fast, settings.retry_memory
        )
        for stage, state in stages:
            chunks.add(_waiting(stage, state))
            scheduler.owned_by_others = state.running_elsewhere
            with Progress(tally, output.progress) as progress:
                _drive(scheduler, stage, progress)
            if tally.left:
                break
    output.say(closing(tally, scheduler.failures, stop.stop_requested, time.monotonic() - start))
    return stop.stop_requested and tally.left > 0


@contextmanager
def started(
    settings: LaunchSettings, work: Work, configs: Iterable[TrialConfig], warn: Say
) -> Iterator[Executor]:
    """Start the executor while the kernel compiles, and stop it at the end of the block.

    The launch says so if that takes long. Machines of a cluster compile before their first trial.
    """
    kinds = [*kinds_of(config for config in configs if config.path == "kernel").values()]
    prepare = partial(_prepare, work.prepare, kinds) if kinds else None
    timer = threading.Timer(ANNOUNCE_AFTER_SECONDS, warn, [COMPILING])
    with ExitStack() as held:
        with work.prepare(kinds) if kinds else nullcontext():
            executor = held.enter_context(make_executor(settings, work.run, prepare))
            if kinds:
                timer.start()
                held.callback(timer.cancel)
        timer.cancel()
        yield executor


def _prepare(prepare: Preparation, kinds: Sequence[TrialConfig]) -> None:
    with prepare(kinds):
        pass


def _drive(scheduler: Scheduler, grid: Grid, progress: Progress) -> None:
    """Run until every trial has an outcome, including trials claimed by other launches."""
    pause = 0.0
    while True:
        worked = False
        while scheduler.step():
            worked = True
            progress.update()
        if scheduler.ending or not scheduler.owned_by_others:
            return
        if not worked:
            time.sleep(pause)
        pause = _poll_other_launches(scheduler, grid)
        progress.update()


def _poll_other_launches(scheduler: Scheduler, grid: Grid) -> float:
    """Count trials that other launches have finished, and queue those that they have released.

    Returns the seconds to wait before the next query if there was nothing to run.
    """
    start = time.monotonic()
    scheduler.store.recover()
    scheduler.store.release()  # a server may commit a claim after its connection broke
    state = scheduler.store.register(grid.trials)
    _count(scheduler.tally, state)
    scheduler.owned_by_others = state.running_elsewhere
    scheduler.chunks.add(_waiting(grid, state))
    return max(POLL_OTHER_LAUNCHES_SECONDS, 5 * (time.monotonic() - start))


def _waiting(grid: Grid, state: Registration) -> list[TrialSpec]:
    trials = {trial.trial_key: trial for trial in grid.trials}
    return [trials[key] for key in state.todo]


def _count(tally: Tally, state: Registration) -> None:
    """Copy the counts of trials that other launches finished from the database to the tally."""
    tally.before = state.done + state.diverged + state.failed + state.cancelled - tally.over
    tally.failed_before = state.failed + state.cancelled - tally.failed


WORKER = "python -m orchestrate work"


def leave(
    store: RetryingStore,
    grid: Grid,
    settings: LaunchSettings,
    job: Job | None,
    say: Callable[[str], None],
) -> ExitCode:
    """Register the grid for workers, and submit the job in which they run."""
    free_trials(store, grid, settings)
    state = store.register(grid.trials)
    if job is None:
        say(f"{registered(grid, state)}; start workers with {WORKER} --db {store.safe_url}")
        return ExitCode.DONE
    say(f"{registered(grid, state)} · {store.safe_url}")
    if state.todo:
        say(job.submit(len(state.todo), {URL_VARIABLE: settings.store_url}))
    return ExitCode.DONE


def free_trials(store: RetryingStore, grid: Grid, settings: LaunchSettings) -> None:
    """Put the trials of dead launches, and those to be run again, back to pending."""
    store.recover()
    if settings.retry:
        store.retry(settings.retry, [trial.trial_key for trial in grid.trials])


REST = 20.0
"""Least time between two copies, as a multiple of the time that a copy takes."""


@contextmanager
def collected(settings: LaunchSettings, warn: Callable[[str], None]) -> Iterator[None]:
    """Copy the database of the block every ``collect_seconds`` or less often, and once after it.

    What earlier launches of the share have collected, perhaps on machines that are gone, is merged
    before the block. Without a folder nothing is copied.

    Raises
    ------
    StoreError
        If what was collected cannot be merged, or the last copy fails; the local database is kept.
    """
    if settings.collect_in is None:
        yield
        return
    folder, ended = settings.collect_in, threading.Event()
    earlier = f"*.{settings.share}.*.db"
    if any(folder.glob(earlier)):
        for _ in merge_collected(settings.store_url, folder, earlier):
            pass

    def copy_regularly() -> None:
        pause = settings.collect_seconds
        while not ended.wait(pause):
            start = time.monotonic()
            try:
                collect(settings.store_url, folder)
            except StoreError as error:
                warn(f"the results are not copied yet: {error}")
            pause = max(settings.collect_seconds, REST * (time.monotonic() - start))

    thread = threading.Thread(target=copy_regularly, name="collect", daemon=True)
    thread.start()
    try:
        yield
    except DatabaseMovedError:  # another database may have its name
        _stop(thread, ended)
        raise
    except BaseException:
        _stop(thread, ended)
        with suppress(StoreError):  # the first error is the one to report
            collect(settings.store_url, folder)
        raise
    _stop(thread, ended)
    collect(settings.store_url, folder)


def _stop(thread: threading.Thread, ended: threading.Event) -> None:
    ended.set()
    thread.join()


MAX_LISTED_CAUSES = 3
"""Causes of failure that the summary lists."""


def registered(grid: Grid, state: Registration) -> str:
    """Return the counts of a grid that was registered for workers."""
    return f"{_counts(grid, state, 'running')}, {len(state.todo):,} registered"


def _counts(grid: Grid, state: Registration, running: str, heading: str = "") -> str:
    """Return a line for each reason to leave out trials, and one with the counts by status."""
    lines = [f"left out {count:,} trials: {reason}" for reason, count in grid.left_out.items()]
    if grid.repeats:
        lines.append(f"{grid.repeats:,} of {grid.n_jobs:,} jobs name a trial of the grid again")
    lines.append(f"{heading}{state.done + state.diverged:,} of {state.total:,} already done")
    if state.failed:
        lines[-1] += f", {state.failed:,} failed before (launch.retry=failed runs them again)"
    if state.running_elsewhere:
        lines[-1] += f", {state.running_elsewhere:,} {running}"
    return "\n".join(lines)


def opening(
    grid: Grid, state: Registration, settings: LaunchSettings, url: str, heading: str = ""
) -> str:
    """Return the counts of trials to run, done, failed and left out, after the stage's heading."""
    counts = _counts(grid, state, "running in another launch", heading)
    todo = f"{len(state.todo):,} to run with executor={settings.executor}"
    return f"{counts}, {todo if state.todo else 'nothing to run'} · {url}"


def closing(tally: Tally, failures: Counter[str], stop_requested: bool, seconds: float) -> str:
    """Return the counts of outcomes, the commonest failures, and the number of trials left."""
    lines = [
        f"{tally.total - tally.left - tally.all_failed:,} of {tally.total:,} done, "
        f"{tally.all_failed:,} failed, {tally.diverged:,} diverged now, in {duration(seconds)}"
    ]
    for cause, count in failures.most_common(MAX_LISTED_CAUSES):
        lines.append(f"{count:,} failed: {cause}")
    if tally.left:
        why = "interrupted" if stop_requested else "stopped at the first failure"
        lines.append(f"{why}, {tally.left:,} left: run the same command again to continue")
    return "\n".join(lines)


def worked(tally: Tally, scheduler: Scheduler, left: int, seconds: float) -> str:
    """Return the counts of outcomes of a worker, and the number of trials left to others."""
    lines = [
        f"{tally.done + tally.diverged:,} trials done, {tally.diverged:,} of them diverged, "
        f"{tally.failed:,} failed, in {duration(seconds)}; {left:,} left"
    ]
    if scheduler.refused:
        lines.append(
            f"{scheduler.refused:,} results refused: the lease had run out, and others had claimed "
            f"their trials; give a longer --lease"
        )
    for cause, count in scheduler.failures.most_common(MAX_LISTED_CAUSES):
        lines.append(f"{count:,} failed: {cause}")
    return "\n".join(lines)
