"""The trials themselves, not stand-ins, through every executor: the same rows."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from dopt.run import run_trial
from dopt.spec.config import without_versions
from dopt.spec.trial import TrialSpec
from orchestrate import launch
from orchestrate.__main__ import main
from orchestrate.errors import ExitCode
from orchestrate.runner.start import Work
from orchestrate.store import Reader
from orchestrate.store.maintenance import examine
from tests.orchestrate.faults.laboratory import flaws
from tests.paths import ROOT, ran
from tests.waiting import PATIENCE_SECONDS, until


def words(executor: str, url: str) -> list[str]:
    """Return the words that launch short trials of two systems, one of which changes."""
    grid = ["-m", "env=pendulum,beyond/drifting_pendulum", "policy=d_optimal", "seed=range(2)"]
    task = [
        "task=none,control",
        "task.checkpoints=[3]",
        "task.free_run_steps=4",
        "task.settle_steps=2",
    ]
    small = [f"task.{name}" for name in ("steps=12", "samples=8", "elites=2", "lookahead=3")]
    return [*grid, "env.horizon=12", *task, *small, f"executor={executor}", f"store.url={url}"]


def numbers(url: str) -> list[tuple[object, ...]]:
    """Return the losses of all steps, and what was assessed."""
    with Reader.open(url) as reader:
        losses = "SELECT config_key, seed, t, loss FROM v_curve ORDER BY 1, 2, 3"
        measured = "config_key, seed, t, measure, value"
        measures = f"SELECT {measured} FROM v_assessment ORDER BY {measured}"
        return [tuple(row) for sql in (losses, measures) for row in reader.rows(sql)]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a database of the trials one after the other in this process."""
    url = f"sqlite:///{tmp_path_factory.mktemp('alone') / 'results.db'}"
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("DOPT_DB", raising=False)
        patch.setattr(sys, "argv", ["launch.py", *words("inprocess", url)])
        assert launch.main() == 0
    return url


@pytest.mark.parametrize("executor", ["local", "ray"])
@pytest.mark.xdist_group("real trials")  # one run in one process for all of them
def test_every_executor_stores_the_same_numbers(executor: str, alone: str, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / executor}.db"
    done = ran("orchestrate/launch.py", *words(executor, url))
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(numbers(alone)) == 6 * 12 + 2 * (2 + 4 * 3)
    assert numbers(url) == numbers(alone)


@pytest.mark.xdist_group("real trials")
def test_what_is_stored_names_its_trials(alone: str) -> None:
    assert [one for one in examine(alone) if one.severity == "error"] == []
    with Reader.open(alone) as reader:
        for config in reader.configs():
            again = TrialSpec.from_mapping(without_versions(config.config))
            assert again.trial_key in {row.trial_key for row in reader.trials(config.config_key)}


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
            words = f"bash docs/example/share.sh {tmp_path}/shared {number} {SHARES}".split()
            started = subprocess.Popen(
                [*words, *GRID], cwd=ROOT, env={**os.environ, **given}, stdout=subprocess.PIPE,
                text=True,
            )  # fmt: skip
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
    assert numbers(merged) == numbers(one)
    assert flaws(merged) == []


def test_a_share_that_cannot_be_copied_is_kept(
    share: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    (tmp_path / "cp").write_text("#!/bin/sh\nexit 1\n")
    (tmp_path / "cp").chmod(0o755)
    path = f"{tmp_path}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    assert share(PATH=path).wait(PATIENCE_SECONDS) == ExitCode.INFRASTRUCTURE
    (kept,) = tmp_path.glob("dopt.*/share.db")
    assert len(trials(f"sqlite:///{kept}")) == 7


def test_a_share_is_copied_while_it_runs_and_goes_on_elsewhere(
    share: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    first, copy = share(EVERY="3", SEEDS="5000"), tmp_path / "shared/1-of-3.db"
    until(lambda: copy.exists() and trials(f"sqlite:///{copy}"))
    first.terminate()  # as before the end of a job
    assert first.wait(PATIENCE_SECONDS) == ExitCode.INTERRUPTED
    done = len(trials(f"sqlite:///{copy}"))
    assert [path.name for path in copy.parent.iterdir()] == [copy.name]
    assert f"{min(done, 7)} of 7 already done" in str(share().communicate()[0])
