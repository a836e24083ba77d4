"""Start of a launch: its checks, and its grid, its single trial or its preview.

A grid is registered and runs in stages. A single trial runs in this process, and
``launch.dry_run=true`` shows the preview.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import shlex
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TextIO

from tabulate import tabulate

from dopt.errors import counted
from dopt.kernel import compiling, kinds_of
from dopt.run import run_trial
from dopt.spec.config import TrialConfig, labels
from dopt.spec.trial import TrialSpec
from orchestrate.config import Grid, LaunchSettings, build_grid
from orchestrate.errors import ExitCode, LaunchError
from orchestrate.executors.base import Executor, Run, executor_factory, make_executor
from orchestrate.program import ROOT, answered, exit_code, say, tell
from orchestrate.runner.progress import Interrupt, Progress, Tally, duration
from orchestrate.runner.saving import Patience, RetryingStore, kept_alive, launch_record
from orchestrate.runner.scheduler import Chunks, Scheduler, check_memory
from orchestrate.runner.seed_plan import SeedPlan
from orchestrate.store import (
    FINISHED,
    RETRIED,
    LaunchRecord,
    NoDatabaseError,
    Reader,
    Registration,
    Store,
    StoreUnavailableError,
    TrialRow,
)

if TYPE_CHECKING:
    from orchestrate.config.command_line import Request  # which loads Hydra

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
    progress: TextIO | None = None


def launch_grid(
    grid: Grid,
    settings: LaunchSettings,
    record: LaunchRecord,
    work: Work,
    output: Output,
    tally: Tally | None = None,
) -> ExitCode:
    """Bring every trial of the grid to an outcome, or leave that to workers.

    Parameters
    ----------
    grid, settings
        Trials to run, and the settings of the launch.
    record
        Provenance of the command.
    work, output
        Functions that run a trial and prepare for it, and destinations of messages.
    tally
        Takes the counts of the outcomes, if given.

    Raises
    ------
    LaunchError
        If nothing can run as the settings ask; then nothing is written.
    StoreError, InfrastructureError
        If the database or the workers fail; nothing that was committed is lost.
    """
    if not settings.detach:
        executor_factory(settings).check(settings)

    def body(store: RetryingStore) -> ExitCode:
        free_trials(store, grid, settings)
        run = _GridRun(store, grid, settings, work, output, tally or Tally(0))
        return run.leave_to_workers() if settings.detach else run.until_all_ended()

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
    patience = Patience(settings.patience, output.warn)
    with Store.open(settings.store_url, settings.lease, settings.patience, patience) as store:
        token = store.new_token()
        launch = patience(lambda: store.begin_launch(record, token))
        try:
            with kept_alive(store, launch, settings.lease):
                patient = RetryingStore(store, launch, patience)
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


@dataclass
class _GridRun:
    """Grid in the launch of ``store``, with the counts of its outcomes."""

    store: RetryingStore
    grid: Grid
    settings: LaunchSettings
    work: Work
    output: Output
    tally: Tally

    def leave_to_workers(self) -> ExitCode:
        state = self.store.register(self.grid.trials)
        counts = f"{_counts(self.grid, state, 'running')}, {len(state.todo):,} registered"
        url = shlex.quote(self.store.safe_url)
        self.output.say(f"{counts}; start workers with {WORKER} --db {url}")
        return ExitCode.DONE

    def until_all_ended(self) -> ExitCode:
        plan = SeedPlan(self.grid, self.settings.until)
        stages = self._open_stages(plan)
        first = next(stages, None)
        if first is not None and self._is_interrupted(itertools.chain([first], stages)):
            return ExitCode.INTERRUPTED
        if plan.adaptive and not self.tally.left:
            self.output.say(plan.report())
        return ExitCode.SOME_FAILED if self.tally.all_failed else ExitCode.DONE

    def _open_stages(self, plan: SeedPlan) -> Iterator[tuple[Grid, Registration]]:
        """Register the stages of a launch one after the other; yield those with trials to run."""
        for heading, stage in plan.stages(self.store.final_losses):
            state = self.store.register(stage.trials)
            self.tally.total = state.total
            _count(self.tally, state)
            said = opening(stage, state, self.settings, self.store.safe_url, heading)
            self.output.say(said)
            if self.tally.left:
                yield stage, state

    def _is_interrupted(self, stages: Iterable[tuple[Grid, Registration]]) -> bool:
        """Run the stages with one executor; return whether an interrupt left trials of them."""
        settings, tally = self.settings, self.tally
        configs = {trial.config_key: trial.config for trial in self.grid.trials}.values()
        held = started(settings, self.work, configs, self.output.warn)
        with held as executor, Interrupt() as stop:
            start = time.monotonic()
            chunks = Chunks([], settings.chunk_seconds, executor.slots, executor.batch)
            scheduler = Scheduler(
                self.store, executor, chunks, tally, stop, settings.fail_fast, settings.retry_memory
            )
            for stage, state in stages:
                chunks.add(_waiting(stage, state))
                scheduler.owned_by_others = state.running_elsewhere
                with Progress(tally, self.output.progress) as progress:
                    _drive(scheduler, stage, progress)
                if tally.left:
                    break
        seconds = time.monotonic() - start
        self.output.say(closing(tally, scheduler.failures, stop.stop_requested, seconds))
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


def free_trials(store: RetryingStore, grid: Grid, settings: LaunchSettings) -> None:
    """Put the trials of dead launches, and those to be run again, back to pending."""
    store.recover()
    if settings.retry:
        store.retry(settings.retry, [trial.trial_key for trial in grid.trials])


MAX_LISTED_CAUSES = 3
"""Causes of failure that the summary lists."""


def _counts(grid: Grid, state: Registration, running: str, heading: str = "") -> str:
    """Return a line for each reason to leave out trials, and one with the counts by status."""
    lines = _left_out(grid)
    if grid.repeats:
        lines.append(f"{grid.repeats:,} of {grid.n_jobs:,} jobs name a trial of the grid again")
    lines.append(f"{heading}{state.done + state.diverged:,} of {state.total:,} already done")
    if state.failed:
        lines[-1] += f", {state.failed:,} failed before (launch.retry=failed runs them again)"
    if state.running_elsewhere:
        lines[-1] += f", {state.running_elsewhere:,} {running}"
    return "\n".join(lines)


def _left_out(grid: Grid) -> list[str]:
    return [f"left out {counted(count, 'trial')}: {why}" for why, count in grid.left_out.items()]


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
    done = counted(tally.done + tally.diverged, "trial")
    lines = [
        f"{done} done, {tally.diverged:,} of them diverged, "
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


def checked(request: Request) -> tuple[Grid, LaunchSettings]:
    """Return the checked grid and settings of a launch, or raise ``DoptError``."""
    from dopt.kernel import cache

    grid = build_grid(request.combinations, single=request.single)
    settings = LaunchSettings.from_mapping(request.launch)
    path = executor_factory(settings).path
    if path != "kernel":
        grid = grid.on_path(path)
    if not settings.detach:  # workers may run on other machines
        if any(trial.config.path == "kernel" for trial in grid.trials):
            cache.check_environment()
        check_memory(grid, settings)
    _check_kind(settings, single=request.single)
    return grid, settings


def _check_kind(settings: LaunchSettings, *, single: bool) -> None:
    """Refuse settings that do not go together, or that only a grid can have."""
    if settings.until and single:
        raise LaunchError(
            "launch.until chooses among the seeds of a grid, but a single trial is asked for: add "
            "-m and a range such as 'seed=range(100)', or leave launch.until out."
        )
    if settings.detach and single:
        raise LaunchError(
            "launch.detach is for grids, but a single trial is asked for: add -m, or leave "
            "launch.detach out."
        )
    if settings.detach and settings.until:
        raise LaunchError(
            "launch.until looks at results before it asks for more seeds, but launch.detach leaves "
            "before there are any: leave one of the two out."
        )


@answered
def run(request: Request, grid: Grid, settings: LaunchSettings) -> int:
    """Run a checked grid and return the exit code."""
    for note in grid.notes:
        say(note)
    if settings.dry_run:
        say(preview(grid, settings.store_url, settings.retry))
        if settings.until:
            say("launch.until may need fewer of these seeds: they are run in batches")
        return ExitCode.DONE
    record = launch_record(sys.argv, request.overrides, ROOT)
    if not request.single:
        return launch_grid(grid, settings, record, WORK, Output(say, say, sys.stderr))
    code, line = launch_trial(grid.trials[0], settings, record, WORK)
    say(line)
    return code


_TRACEBACK = "SELECT traceback FROM v_failures WHERE trial_key = :key ORDER BY attempt DESC LIMIT 1"


def launch_trial(
    trial: TrialSpec, settings: LaunchSettings, record: LaunchRecord, work: Work
) -> tuple[ExitCode, str]:
    """Run the trial unless it has an outcome; return the exit code and the line to print.

    A traceback and messages about delays go to the standard error.
    """
    if not executor_factory(settings).in_process:
        settings = dataclasses.replace(settings, executor="inprocess")
    grid, tally = Grid([trial], n_jobs=1, left_out={}), Tally(0)
    quiet = Output(lambda _: None, lambda text: tell(sys.stderr, f"{text}\n"))  # one line is told
    code = launch_grid(grid, settings, record, work, quiet, tally)
    with Reader.open(settings.store_url) as reader:
        row = _row(reader, trial)
        if row is None:  # interrupted before it was registered
            return code, f"{_name(trial)} · not started · {reader.safe_url}"
        if row.status == "failed":
            found = reader.rows(_TRACEBACK, key=trial.trial_key)
            tell(sys.stderr, str(found[0][0]) if found else "")
        outcome = _outcome(row)
        if not tally.over and row.status == "done":
            outcome = f"already done, nothing to run · {outcome}"
        elif not tally.over and row.status in RETRIED:
            outcome = f"already run (launch.retry={row.status} runs it again) · {outcome}"
        return code, f"{_name(trial)} · {outcome} · {reader.safe_url}"


def _row(reader: Reader, trial: TrialSpec) -> TrialRow | None:
    rows = reader.trials(trial.config_key)
    return next((row for row in rows if row.seed == trial.seed), None)


def _name(trial: TrialSpec) -> str:
    columns = trial.columns()
    words = [f"{key}={columns[key]}" for key in ("env", "policy", "model", "width") if columns[key]]
    return " ".join([*words, f"seed={trial.seed}"])


def _outcome(row: TrialRow) -> str:
    if row.status == "failed":
        return f"failed with {row.error_type}: {row.error_message}"
    if row.n_steps is None or row.wall_seconds is None:
        return row.status
    steps = f"{row.n_steps:,} steps in {row.wall_seconds:.2f} s"
    if row.status == "diverged":
        return f"diverged at step {row.diverged_at} · {steps}"
    return f"final loss {row.final_loss:.4g} · best {row.best_loss:.4g} · {steps}"


COUNTS = ("trials", "done", "failed", "to run")
_COUNTED = {**dict.fromkeys(FINISHED, "done"), "failed": "failed", "cancelled": "failed"}


def preview(grid: Grid, url: str, retry: str | None = None) -> str:
    """Return a table of the configurations: trials requested, done, failed and to run.

    Trials that ``retry`` runs again count as to run. A database that does not exist is not created.
    """
    again = RETRIED[retry] if retry else ()
    status = _statuses(url)
    rows: dict[str, Counter[str]] = {}
    for trial in grid.trials:
        row = rows.setdefault(trial.config_key, Counter())
        row["trials"] += 1
        found = status.get(trial.trial_key)
        row["to run" if found in again else _COUNTED.get(found or "", "to run")] += 1
    configs = list({trial.config_key: trial for trial in grid.trials}.values())
    lines = [["env", "configuration", *COUNTS]]
    for trial, label in zip(configs, _labels(configs), strict=True):
        numbers = [f"{rows[trial.config_key][name]:,}" for name in COUNTS]
        lines.append([trial.system.name, label, *numbers])
    total = sum(rows.values(), Counter[str]())
    end = f"{counted(total['trials'], 'trial')}, {total['done']:,} done, {total['to run']:,} to run"
    table = tabulate(lines, tablefmt="plain", disable_numparse=True)
    return "\n".join([table, *_left_out(grid), end])


def _labels(configs: Sequence[TrialSpec]) -> list[str]:
    """Return the stored labels, or others where these do not tell all configurations apart."""
    stored = [str(trial.columns()["label"]) for trial in configs]
    pairs = {(trial.system.name, label) for trial, label in zip(configs, stored, strict=True)}
    if len(pairs) == len(configs):
        return stored
    return labels([json.loads(trial.config_json) for trial in configs])


def _statuses(url: str) -> dict[str, str]:
    try:
        reader = Reader.open(url)
    except NoDatabaseError:
        return {}
    with reader:
        return dict(map(tuple, reader.rows("SELECT trial_key, status FROM trial")))
