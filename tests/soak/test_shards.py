"""Twenty shares of ten thousand trials, merged into the rows of one database."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from orchestrate.config import Grid
from orchestrate.config.launch_settings import LaunchSettings, Share
from orchestrate.errors import ExitCode
from orchestrate.runner.run_grid import Work, launch_grid
from orchestrate.store.maintenance import merge_collected
from tests.orchestrate.conftest import RECORD
from tests.orchestrate.faults.outcome import flaws, results
from tests.orchestrate.faults.trials import outcome
from tests.orchestrate.standins import specification

TRIALS, SHARES, HORIZON = 10_000, 20, 50
MOST_SECONDS = 20.0

pytestmark = [pytest.mark.soak, pytest.mark.timeout(600)]


def run(grid: Grid, settings: LaunchSettings) -> None:
    work = Work(outcome, prepare=lambda: None)
    assert launch_grid(grid, settings, RECORD, work, lambda _: None, None) == ExitCode.DONE


def test_twenty_shares_become_one_database(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    first = specification(0, horizon=HORIZON)
    grid = Grid([first.with_seed(seed) for seed in range(TRIALS)], n_jobs=TRIALS, left_out={})
    one, merged = f"sqlite:///{tmp_path}/one.db", f"sqlite:///{tmp_path}/merged.db"
    run(grid, LaunchSettings("inprocess", one))
    shared = tmp_path / "shared"
    for number in range(1, SHARES + 1):
        part = Share(number, SHARES)
        url = f"sqlite:///{tmp_path}/disk/s.{part}.here.db"
        settings = LaunchSettings("inprocess", url, share=part, collect_in=shared)
        run(grid.only(part.holds), settings)
    start = time.monotonic()
    added = sum(sum(one.added.values()) for one in merge_collected(merged, shared))
    seconds = time.monotonic() - start
    request.config.get_terminal_writer().line(f"\n{added:,} trials merged in {seconds:.1f} s")
    assert added == TRIALS
    assert results(merged) == results(one)
    assert flaws(merged) == []
    assert seconds <= MOST_SECONDS
