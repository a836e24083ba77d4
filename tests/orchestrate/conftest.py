"""A grid of short trials, and a launch of it in this process."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from orchestrate.config import Grid, LaunchSettings
from orchestrate.errors import ExitCode
from orchestrate.executors.base import Run
from orchestrate.program import readable_streams
from orchestrate.runner.start import Output, Work, launch_grid
from orchestrate.store import LaunchRecord, Reader
from tests.orchestrate.standins import quick, specification

RECORD = LaunchRecord(argv=["launch"], overrides=[], host="here", pid=1)


class Launches:
    """Launches stand-ins into one database and keeps what they said."""

    def __init__(self, folder: Path) -> None:
        self.url = f"sqlite:///{folder / 'results.db'}"
        self.said: list[str] = []

    def __call__(
        self, run: Run = quick, seeds: int = 5, executor: str = "inprocess", **settings: Any
    ) -> ExitCode:
        grid = Grid([specification(seed) for seed in range(seeds)], n_jobs=seeds, left_out={})
        chosen = LaunchSettings(executor=executor, store_url=self.url, **{"workers": 2, **settings})
        work = Work(run)
        return launch_grid(grid, chosen, RECORD, work, Output(*2 * [self.said.append]))

    def statuses(self) -> dict[int, str]:
        """Return the status of each seed."""
        with Reader.open(self.url) as reader:
            return {row.seed: row.status for row in reader.trials(specification().config_key)}

    def query(self, sql: str) -> list[tuple[Any, ...]]:
        with Reader.open(self.url) as reader:
            return [tuple(row) for row in reader.rows(sql)]


@pytest.fixture
def launches(tmp_path: Path) -> Launches:
    return Launches(tmp_path)


@pytest.fixture
def command_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs ``launch.py`` in this process: exit code, output and errors."""
    from orchestrate import launch
    from orchestrate.runner import start

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["launch.py", *arguments])
        readable_streams()  # as the frame of every program does
        try:
            code = int(launch.main())
        except SystemExit as end:
            code = int(end.code or 0)
        assert "HYDRA_FULL_ERROR" not in os.environ, "what runs after a launch would inherit it"
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.delenv("DOPT_DB", raising=False)
    monkeypatch.setattr(start, "WORK", Work(quick))
    return run
