"""The trials themselves, not stand-ins, through every executor: the same rows."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from dopt.errors import SpecificationError
from dopt.run import run_trial
from dopt.spec.config import without_versions
from dopt.spec.trial import TrialSpec
from orchestrate import launch
from orchestrate.__main__ import main
from orchestrate.config import Combination, Grid, LaunchSettings, build_grid
from orchestrate.errors import ExitCode
from orchestrate.runner.start import Work, launch_grid
from orchestrate.store import Reader
from orchestrate.store.maintenance import examine
from tests.orchestrate.conftest import RECORD
from tests.orchestrate.faults.laboratory import flaws
from tests.orchestrate.standins import specification
from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS, until


def words(executor: str, url: str) -> list[str]:
    """Return the words that launch two short trials of two systems, one of which changes."""
    grid = ["-m", "env=pendulum,beyond/drifting_pendulum", "policy=d_optimal", "seed=range(2)"]
    return [*grid, "env.horizon=12", f"executor={executor}", f"store.url={url}"]


def losses(url: str) -> list[float]:
    with Reader.open(url) as reader:
        configs = sorted(reader.configs(), key=lambda config: config.config_key)
        return [
            float(loss)
            for config in configs
            for loss in reader.curves(config.config_key).values.ravel().tolist()
        ]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> list[float]:
    """Return the losses of the trials one after the other in this process."""
    url = f"sqlite:///{tmp_path_factory.mktemp('alone') / 'results.db'}"
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("DOPT_DB", raising=False)
        patch.setattr(sys, "argv", ["launch.py", *words("inprocess", url)])
        assert launch.main() == 0
    return losses(url)


@pytest.mark.parametrize("executor", ["local", "ray"])
@pytest.mark.xdist_group("real trials")  # one run in one process for all of them
def test_every_executor_stores_the_same_losses(
    executor: str, alone: list[float], tmp_path: Path
) -> None:
    url = f"sqlite:///{tmp_path / executor}.db"
    done = subprocess.run(
        [sys.executable, "orchestrate/launch.py", *words(executor, url)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(alone) == 48
    assert losses(url) == alone


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
    work = Work(run_trial)
    code = launch_grid(trials, settings, RECORD, work, lambda _: None, stream=None)
    assert code is ExitCode.DONE
    return url


def rows(url: str) -> list[tuple[object, ...]]:
    with Reader.open(url) as reader:
        sql = "SELECT seed, t, measure, value FROM v_assessment ORDER BY seed, t, measure"
        return [tuple(row) for row in reader.rows(sql)]


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


GRID = ("policy=random", "env.horizon=5", "executor=inprocess")
SHARES = 3

Launch = Callable[..., tuple[int, str, str]]


@pytest.fixture
def share(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Return a function that starts docs/example/share.sh for the first or another share."""
    with ExitStack() as stack:

        def start(number: int = 1, **settings: str) -> subprocess.Popen[str]:
            path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
            given = {"TMPDIR": str(tmp_path), "SEEDS": "20", "PATH": path, **settings}
            words = [
                "bash",
                "docs/example/share.sh",
                f"{tmp_path}/shared",
                f"{number}",
                f"{SHARES}",
            ]
            started = subprocess.Popen(
                [*words, *GRID],
                cwd=ROOT,
                env={**os.environ, **given},
                stdout=subprocess.PIPE,
                text=True,
            )
            return stack.enter_context(started)

        yield start


def trials(url: str) -> list[tuple[object, ...]]:
    with Reader.open(url) as reader:
        sql = "SELECT trial_key, final_loss FROM trial WHERE status = 'done'"
        return sorted(map(tuple, reader.rows(sql)))


def test_merged_shares_are_the_rows_of_one_database(
    share: Callable[..., subprocess.Popen[str]],
    command_line: Launch,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for number in range(1, SHARES + 1):
        assert share(number).wait(PATIENCE_SECONDS) == 0
    one, merged = f"sqlite:///{tmp_path}/one.db", f"sqlite:///{tmp_path}/merged.db"
    monkeypatch.setattr("orchestrate.runner.start.WORK", Work(run_trial))
    assert command_line("-m", *GRID, "seed=range(20)", f"store.url={one}")[0] == 0
    assert main(["merge", f"{tmp_path}/shared", "--db", merged]) == 0
    assert trials(merged) == trials(one)
    assert losses(merged) == losses(one)
    assert flaws(merged) == []


def test_a_share_is_copied_while_it_runs_and_goes_on_elsewhere(
    share: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    first, copy = share(EVERY="1", SEEDS="5000"), tmp_path / "shared/1-of-3.db"
    until(lambda: copy.exists() and trials(f"sqlite:///{copy}"))
    first.terminate()  # as before the end of a job
    assert first.wait(PATIENCE_SECONDS) == ExitCode.INTERRUPTED
    done = len(trials(f"sqlite:///{copy}"))
    assert [path.name for path in copy.parent.iterdir()] == [copy.name]
    assert f"{min(done, 7)} of 7 already done" in str(share().communicate()[0])
