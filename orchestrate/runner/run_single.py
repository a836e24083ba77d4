"""Launch of a single trial in this process, with its result as one line."""

from __future__ import annotations

import dataclasses
import sys

from dopt.spec.trial import TrialSpec
from orchestrate.cli_parser import tell
from orchestrate.config.grid import Grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.errors import ExitCode
from orchestrate.executors.registry import executor_factory
from orchestrate.runner.run_grid import Work, launch_grid
from orchestrate.store import LaunchRecord, NoDatabaseError, Reader, SchemaVersionError, TrialRow


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
    code = launch_grid(grid, settings, record, work, say=_ignore, stream=None, warn=_warn)
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


def _ignore(_: str) -> None:
    """Ignore the messages of a grid: a single trial prints one line."""


def _warn(text: str) -> None:
    tell(sys.stderr, f"{text}\n")


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
