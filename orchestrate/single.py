"""One trial in this process, stored like any other, and its result as a line."""

from __future__ import annotations

import dataclasses
import sys

from dopt.spec import TrialSpec
from orchestrate.campaign import Work, launch_grid
from orchestrate.errors import ExitCode
from orchestrate.grid import Grid
from orchestrate.settings import LaunchSettings
from orchestrate.store import LaunchRecord, Reader, TrialRow


def launch_trial(
    trial: TrialSpec, settings: LaunchSettings, record: LaunchRecord, work: Work
) -> tuple[ExitCode, str]:
    """Run the trial unless it is done already; return the exit code and the line to print.

    A traceback goes to the standard error.
    """
    together = settings.executor == "lockstep"
    here = settings if together else dataclasses.replace(settings, executor="inprocess")
    grid = Grid([trial], asked=1, left_out={})
    code = launch_grid(grid, here, record, work, say=_nothing, stream=None, warn=_warn)
    with Reader.open(settings.store_url) as reader:
        row = next(row for row in reader.trials(trial.config_key) if row.seed == trial.seed)
        if row.status == "failed":
            sys.stderr.write(_traceback(reader, trial))
        return code, f"{_name(trial)} · {_outcome(row)} · {reader.safe_url}"


def _nothing(_: str) -> None:
    """Say nothing: the one line at the end is enough."""


def _warn(text: str) -> None:
    sys.stderr.write(f"{text}\n")


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


def _traceback(reader: Reader, trial: TrialSpec) -> str:
    """Return the text of the last failure; the key is hexadecimal digits and needs no quoting."""
    rows = reader.query(
        f"SELECT traceback FROM v_failures WHERE trial_key = '{trial.trial_key}' "
        "ORDER BY attempt DESC LIMIT 1"
    )
    return str(rows[0][0]) if rows else ""
