"""Start of a launch: its checks, and its grid, its single trial or its preview.

A grid runs in :mod:`orchestrate.runner.run_grid`; a single trial in this process, and the preview
of ``launch.dry_run=true``, are here.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections import Counter
from collections.abc import Sequence

from tabulate import tabulate

from dopt.spec.config import labels
from dopt.spec.trial import TrialSpec
from orchestrate.config import Grid, build_grid
from orchestrate.config.command_line import Request
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.config.options import check_launch
from orchestrate.errors import ExitCode, LaunchError
from orchestrate.executors.base import executor_factory, make_job
from orchestrate.program import ROOT, answered, say, tell
from orchestrate.runner.run_grid import WORK, Work, launch_grid
from orchestrate.runner.saving import launch_record
from orchestrate.runner.scheduler import check_memory
from orchestrate.store import (
    FINISHED,
    RETRIED,
    LaunchRecord,
    NoDatabaseError,
    Reader,
    SchemaVersionError,
    TrialRow,
)


def checked(request: Request) -> tuple[Grid, LaunchSettings]:
    """Return the checked grid and settings of a launch, or raise ``DoptError``."""
    grid = build_grid(request.combinations, single=request.single)
    settings = LaunchSettings.from_mapping(request.launch)
    check_launch(request.launch)
    from dopt.kernel import cache

    path = executor_factory(settings).path
    if path != "kernel":
        grid = grid.on_path(path)
    if settings.share:
        grid = grid.only(settings.share.holds)
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
    leaving = _leaving(settings)
    if single and (leaving or settings.share):
        key = leaving or "launch.share"
        raise LaunchError(
            f"{key} is for grids, but a single trial is asked for: add -m, or leave {key} out."
        )
    if settings.share and (leaving or settings.until):
        raise LaunchError(
            f"{leaving or 'launch.until'} needs the whole grid in one database, but launch.share "
            "takes a part of it: leave one of the two out."
        )
    if leaving and settings.until:
        raise LaunchError(
            f"launch.until looks at results before it asks for more seeds, but {leaving} leaves "
            "before there are any: leave one of the two out."
        )


def _leaving(settings: LaunchSettings) -> str:
    """Return the setting by which a launch leaves its grid to workers; empty without one."""
    if settings.detach:
        return "launch.detach"
    return f"executor={settings.executor}" if make_job(settings) else ""


@answered
def run(request: Request, grid: Grid, settings: LaunchSettings) -> int:
    """Run a checked grid and return the exit code."""
    for note in grid.notes:
        say(note)
    if settings.dry_run:
        say(preview(grid, settings.store_url, settings.retry))
        if settings.until:
            say("launch.until may need fewer of these seeds: they are run in batches")
        if job := make_job(settings):
            say(job.text(len(grid.trials)))
        return ExitCode.DONE
    record = launch_record(sys.argv, request.overrides, ROOT)
    if not request.single:
        return launch_grid(grid, settings, record, WORK, say=say, stream=sys.stderr)
    code, line = launch_trial(grid.trials[0], settings, record, WORK)
    say(line)
    return code


def launch_trial(
    trial: TrialSpec, settings: LaunchSettings, record: LaunchRecord, work: Work
) -> tuple[ExitCode, str]:
    """Run the trial unless it has an outcome; return the exit code and the line to print.

    A traceback and messages about delays go to the standard error.
    """
    if not executor_factory(settings).in_process:
        settings = dataclasses.replace(settings, executor="inprocess")
    before = _attempts(trial, settings.store_url)
    grid = Grid([trial], n_jobs=1, left_out={})
    code = launch_grid(
        grid,
        settings,
        record,
        work,
        say=lambda _: None,  # a single trial prints one line
        warn=lambda text: tell(sys.stderr, f"{text}\n"),
    )
    with Reader.open(settings.store_url) as reader:
        row = _row(reader, trial)
        if row is None:  # interrupted before it was registered
            return code, f"{_name(trial)} · not started · {reader.safe_url}"
        if row.status == "failed":
            tell(sys.stderr, _traceback(reader, trial))
        was_done = row.attempt == before and row.status != "pending"
        outcome = f"{_already_run(row)} · {_outcome(row)}" if was_done else _outcome(row)
        return code, f"{_name(trial)} · {outcome} · {reader.safe_url}"


def _attempts(trial: TrialSpec, url: str) -> int:
    """Return how often the trial has been started; 0 where there is no database yet."""
    try:
        with Reader.open(url) as reader:
            row = _row(reader, trial)
    except (NoDatabaseError, SchemaVersionError):  # none yet, or Store.open explains it
        return 0
    return 0 if row is None else row.attempt


def _row(reader: Reader, trial: TrialSpec) -> TrialRow | None:
    rows = reader.trials(trial.config_key)
    return next((row for row in rows if row.seed == trial.seed), None)


def _name(trial: TrialSpec) -> str:
    columns = trial.columns()
    words = [f"{key}={columns[key]}" for key in ("env", "policy", "model", "width") if columns[key]]
    return " ".join([*words, f"seed={trial.seed}"])


def _already_run(row: TrialRow) -> str:
    if row.status == "done":
        return "already done, nothing to run"
    return f"already run (launch.retry={row.status} runs it again)"


def _outcome(row: TrialRow) -> str:
    if row.status == "failed":
        return f"failed with {row.error_type}: {row.error_message}"
    if row.n_steps is None or row.wall_seconds is None:
        return row.status
    steps = f"{row.n_steps:,} steps in {row.wall_seconds:.2f} s"
    if row.status == "diverged":
        return f"diverged at step {row.diverged_at} · {steps}"
    return f"final loss {row.final_loss:.4g} · best {row.best_loss:.4g} · {steps}"


def _traceback(reader: Reader, trial: TrialSpec) -> str:
    """Return the traceback of the last failure."""
    rows = reader.rows(
        "SELECT traceback FROM v_failures WHERE trial_key = :key ORDER BY attempt DESC LIMIT 1",
        key=trial.trial_key,
    )
    return str(rows[0][0]) if rows else ""


COUNTS = ("trials", "done", "failed", "to run")


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
        row["to run" if found in again else _heading(found)] += 1
    configs = list({trial.config_key: trial for trial in grid.trials}.values())
    lines = [["env", "configuration", *COUNTS]]
    for trial, label in zip(configs, _labels(configs), strict=True):
        numbers = [f"{rows[trial.config_key][name]:,}" for name in COUNTS]
        lines.append([trial.system.name, label, *numbers])
    left_out = [f"left out {count:,} trials: {why}" for why, count in grid.left_out.items()]
    total = sum(rows.values(), Counter[str]())
    plural = "" if total["trials"] == 1 else "s"
    end = f"{total['trials']:,} trial{plural}, {total['done']:,} done, {total['to run']:,} to run"
    table = tabulate(lines, tablefmt="plain", disable_numparse=True)
    return "\n".join([table, *left_out, end])


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


def _heading(status: str | None) -> str:
    if status in FINISHED:
        return "done"
    return "failed" if status in ("failed", "cancelled") else "to run"
