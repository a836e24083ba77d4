"""Trials with a task through whole launches: the same rows by every way, and whole ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from dopt.errors import SpecificationError
from dopt.run import run_trial
from dopt.spec.config import without_versions
from dopt.spec.trial import TrialSpec
from orchestrate.config import Combination, Grid, build_grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.errors import ExitCode
from orchestrate.runner.run_grid import Work, launch_grid
from orchestrate.store import Reader
from orchestrate.store.doctor import examine
from tests.orchestrate.conftest import RECORD
from tests.orchestrate.standins import specification

SHORT = {
    "name": "control",
    "checkpoints": [3],
    "steps": 12,
    "settle_steps": 2,
    "samples": 8,
    "elites": 2,
    "lookahead": 3,
    "free_run_steps": 4,
}


def grid(task: object, seeds: int) -> Grid:
    settings = {**specification(0).to_mapping(), "task": task}
    return build_grid([Combination(settings, seeds=range(seeds))])


def launched(folder: Path, executor: str, trials: Grid) -> str:
    """Run a grid of real trials into a database of its own; return its URL."""
    url = f"sqlite:///{folder / executor}.db"
    settings = LaunchSettings(executor=executor, store_url=url, workers=2)
    work = Work(run_trial, prepare=lambda: None)
    code = launch_grid(trials, settings, RECORD, work, lambda _: None, stream=None)
    assert code is ExitCode.DONE
    return url


def rows(url: str) -> list[tuple[object, ...]]:
    with Reader.open(url) as reader:
        sql = "SELECT seed, t, measure, value FROM v_assessment ORDER BY seed, t, measure"
        return [tuple(row) for row in reader.query(sql)]


def test_the_rows_do_not_depend_on_the_executor(tmp_path: Path) -> None:
    trials = grid(SHORT, seeds=3)
    alone = launched(tmp_path, "inprocess", trials)
    assert len(rows(alone)) == 3 * (2 + 4 * 3)
    assert rows(launched(tmp_path, "local", trials)) == rows(alone)
    assert [one for one in examine(alone) if one.severity == "error"] == []
    with Reader.open(alone) as reader:
        (config,) = reader.configs()
    again = TrialSpec.from_mapping(without_versions(config.config))
    assert [trial.trial_key for trial in trials.trials][:1] == [again.trial_key]


def test_a_task_of_none_is_no_task() -> None:
    keys = [trial.trial_key for trial in grid({"name": "none"}, seeds=2).trials]
    assert keys == [specification(seed).trial_key for seed in range(2)]


def test_a_checkpoint_beyond_the_end_stops_before_anything_runs() -> None:
    with pytest.raises(SpecificationError, match="step 9, but a trial has 5 steps"):
        grid({**SHORT, "checkpoints": [9]}, seeds=1)
