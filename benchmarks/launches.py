"""Launches in this process, and stand-in records of a launch for the database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from dopt.kernel import warm_up
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from orchestrate.config.grid import Grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.errors import ExitCode
from orchestrate.runner.run_grid import Work, launch_grid
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
    rate
        Trials per second once every worker has ended its first one, which loads compiled code.
    """

    span: float
    work: float
    rate: float


def launch_trials(url: str, specs: Sequence[TrialSpec], workers: int) -> Accounts:
    """Run the trials of one configuration on the local executor."""
    settings = LaunchSettings(executor="local", store_url=url, workers=workers)
    grid = Grid(list(specs), n_jobs=len(specs), left_out={})
    work = Work(run_trial, warm_up)
    code = launch_grid(grid, settings, RECORD, work, say=_nothing, stream=None)
    if code is not ExitCode.DONE:
        raise RuntimeError(f"the launch ended with {code!r}, but {ExitCode.DONE!r} is expected.")
    with Reader.open(url) as reader:
        rows = reader.rows("SELECT pid, started, ended, wall_seconds FROM attempt")
    return _accounts(
        [(pid, _seconds(start), _seconds(end), work) for pid, start, end, work in rows]
    )


def _accounts(rows: Sequence[tuple[int, float, float, float]]) -> Accounts:
    """Return the accounts of trials, each with its process, start, end and own seconds."""
    first_ends: dict[int, float] = {}
    for pid, _, end, _ in rows:
        first_ends[pid] = min(end, first_ends.get(pid, end))
    steady, last = max(first_ends.values()), max(end for _, _, end, _ in rows)
    later = sum(end > steady for _, _, end, _ in rows)
    span = last - min(start for _, start, _, _ in rows)
    return Accounts(span, sum(work for *_, work in rows), later / (last - steady))


def _seconds(stamp: str) -> float:
    return datetime.fromisoformat(stamp).timestamp()


def _nothing(_: str) -> None:
    """Say nothing."""


def run_record() -> RunRecord:
    """Return the record of a run that took no time."""
    now = datetime.now(UTC)
    return RunRecord("benchmark", 1, 0.0, 0.0, 0, now, now)


def claims_for(store: Store, launch: int, specs: Sequence[TrialSpec]) -> list[Claim]:
    """Register trials and claim all of them."""
    return store.claim(launch, store.register(launch, specs).todo)
