"""Launches in this process, and stand-ins for what a launch tells the database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from dopt.exploration import run_trial
from dopt.kernel import warm_up
from dopt.spec import TrialSpec
from orchestrate.campaign import Work, launch_grid
from orchestrate.errors import ExitCode
from orchestrate.grid import Grid
from orchestrate.settings import LaunchSettings
from orchestrate.store import Claim, LaunchRecord, Reader, RunRecord, Store

RECORD = LaunchRecord(argv=["benchmarks"], overrides=[], host="benchmark", pid=1)


@dataclass(frozen=True)
class Accounts:
    """What the trials of a launch took.

    Attributes
    ----------
    span
        Seconds from the start of the first trial to the end of the last one.
    work
        Sum of the seconds that the trials took themselves.
    """

    span: float
    work: float


def launch_trials(url: str, specs: Sequence[TrialSpec], workers: int) -> Accounts:
    """Run the trials of one cell on the local executor."""
    settings = LaunchSettings(executor="local", store_url=url, workers=workers)
    grid = Grid(list(specs), asked=len(specs), left_out={})
    work = Work(run_trial, warm_up)
    code = launch_grid(grid, settings, RECORD, work, say=_nothing, stream=None)
    if code is not ExitCode.DONE:
        raise RuntimeError(f"the launch ended with {code!r}, but {ExitCode.DONE!r} is expected.")
    with Reader.open(url) as reader:
        first, last, total = reader.query(
            "SELECT min(started), max(ended), sum(wall_seconds) FROM attempt"
        )[0]
    span = datetime.fromisoformat(last) - datetime.fromisoformat(first)
    return Accounts(span.total_seconds(), float(total))


def _nothing(_: str) -> None:
    """Say nothing."""


def run_record() -> RunRecord:
    """Return the record of a run that took no time."""
    now = datetime.now(UTC)
    return RunRecord("benchmark", 1, 0.0, 0.0, 0, now, now)


def claims_for(store: Store, launch: int, specs: Sequence[TrialSpec]) -> list[Claim]:
    """Register trials and claim all of them."""
    return store.claim(launch, store.register(launch, specs).todo)
