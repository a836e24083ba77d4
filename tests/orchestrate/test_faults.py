"""A launch that is ended from outside loses nothing, and the same command completes the grid."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from orchestrate.store import NoDatabaseError, Reader, StoreError
from tests.orchestrate.conftest import ROOT

TRIALS = 24
SCRIPT = "tests.orchestrate.interrupted_launch"


class Grid:
    """A grid of trials of a tenth of a second each, in a database of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.url = f"sqlite:///{folder / 'results.db'}"

    @contextmanager
    def launched(self) -> Iterator[subprocess.Popen[str]]:
        process = subprocess.Popen(
            [sys.executable, "-m", SCRIPT, str(self.folder), str(TRIALS)],
            cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        try:
            yield process
        finally:
            process.kill()
            process.communicate()

    def complete(self) -> str:
        with self.launched() as process:
            output, errors = process.communicate(timeout=60)
        assert process.returncode == 0, output + errors
        return output

    def count(self, condition: str = "status = 'done'") -> int:
        try:
            with Reader.open(self.url) as reader:
                return int(reader.query(f"SELECT count(*) FROM trial WHERE {condition}")[0][0])
        except (NoDatabaseError, StoreError):
            return 0

    def rows(self) -> list[tuple[object, ...]]:
        with Reader.open(self.url) as reader:
            return [
                tuple(row)
                for row in reader.query("SELECT seed, t, loss FROM v_curve ORDER BY seed, t")
            ]

    def children(self, process: subprocess.Popen[str]) -> list[int]:
        text = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text()
        return [int(word) for word in text.split()]


@pytest.fixture
def grid(tmp_path: Path) -> Grid:
    return Grid(tmp_path)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[object, ...]]:
    grid = Grid(tmp_path_factory.mktemp("undisturbed"))
    grid.complete()
    return grid.rows()


def until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split(")")[1].split()[0] != "Z"
    except OSError:
        return False


def test_a_killed_driver_leaves_whole_trials_and_no_process(
    grid: Grid, undisturbed: list[tuple[object, ...]]
) -> None:
    with grid.launched() as process:
        until(lambda: grid.count() >= 5)
        workers = grid.children(process)
        process.kill()
        process.wait()
    until(lambda: not any(map(alive, workers)))
    before = grid.count()
    assert 5 <= before < TRIALS
    assert f"{before} of {TRIALS} already done, {TRIALS - before} to run" in grid.complete()
    assert grid.rows() == undisturbed


def test_a_killed_worker_costs_nothing(grid: Grid, undisturbed: list[tuple[object, ...]]) -> None:
    with grid.launched() as process:
        until(lambda: grid.count() >= 5)
        os.kill(grid.children(process)[0], signal.SIGKILL)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 0, output + errors
    assert grid.rows() == undisturbed


def test_one_interrupt_ends_what_runs_and_frees_the_rest(
    grid: Grid, undisturbed: list[tuple[object, ...]]
) -> None:
    with grid.launched() as process:
        until(lambda: grid.count() >= 5)
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 130, output + errors
    assert "the same command goes on from here" in output
    assert "Traceback" not in errors
    done = grid.count()
    assert done < TRIALS
    assert grid.count("status = 'pending'") == TRIALS - done
    grid.complete()
    assert grid.rows() == undisturbed


def test_two_interrupts_stop_at_once_and_lose_nothing_committed(
    grid: Grid, undisturbed: list[tuple[object, ...]]
) -> None:
    with grid.launched() as process:
        until(lambda: grid.count() >= 5)
        workers = grid.children(process)
        process.send_signal(signal.SIGINT)
        time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 130, output + errors
    assert "Traceback" not in errors
    assert not any(map(alive, workers))
    assert grid.count() >= 5
    assert grid.count("status = 'running'") == 0
    grid.complete()
    assert grid.rows() == undisturbed


def test_two_launches_share_a_new_database_and_run_nothing_twice(
    grid: Grid, undisturbed: list[tuple[object, ...]]
) -> None:
    with grid.launched() as one, grid.launched() as other:
        for process in (one, other):
            output, errors = process.communicate(timeout=60)
            assert process.returncode == 0, output + errors
    assert grid.rows() == undisturbed
    assert grid.count("attempt > 1") == 0
