"""One contract, run over every executor."""

from __future__ import annotations

import errno
import importlib
import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.errors import ExitCode, InfrastructureError, LaunchError
from orchestrate.executors.base import Event, Executor, Run, Task, TaskDone, WorkerLost
from orchestrate.executors.inprocess import InProcessExecutor
from orchestrate.executors.local import LocalExecutor
from orchestrate.program import exit_code
from orchestrate.records import Failure
from tests.orchestrate.executors.names import ALL, WITH_PROCESSES, WORKERS
from tests.orchestrate.loaded_modules import report_modules
from tests.orchestrate.standins import BROKEN_SEED, deadly, quick, raising, slow, specification
from tests.waiting import until

Make = Callable[[Run], Executor]

for_all = pytest.mark.parametrize("executor", ALL, indirect=True)


def tasks(seeds: Sequence[int]) -> list[Task]:
    trials = [specification(seed) for seed in seeds]
    return [Task(trial.trial_key, trial) for trial in trials]


def seed_of(key: str, among: int = 20) -> int:
    return {specification(seed).trial_key: seed for seed in range(among)}[key]


def drain(executor: Executor) -> list[Event]:
    events: list[Event] = []

    def is_idle() -> bool:
        events.extend(executor.wait(0.5) if executor.pending else [])
        return not executor.pending

    until(is_idle, lambda: f"there is only {events}")
    return events


def report_threads(_: TrialSpec) -> TrialResult:
    raise RuntimeError(os.environ.get("OMP_NUM_THREADS", "none"))


@pytest.fixture
def make(executor: str) -> Iterator[Make]:
    """Return a function that gives a started executor for a stand-in."""
    started: list[Executor] = []

    def start(run: Run) -> Executor:
        started.append(new(executor, run))
        started[-1].start()
        return started[-1]

    yield start
    for one in started:
        one.stop()


def new(name: str, run: Run) -> Executor:
    if name == "inprocess":
        return InProcessExecutor(run)
    if name == "local":
        return LocalExecutor(run, workers=WORKERS)
    ray = importlib.import_module("orchestrate.executors.ray.executor")
    return ray.RayExecutor(run, workers=WORKERS)  # type: ignore[no-any-return]


@for_all
def test_every_task_gets_its_result(make: Make) -> None:
    executor = make(quick)
    for seeds in ([0, 1, 2], [3], [], [4, 5]):
        executor.submit(tasks(seeds))
    events = drain(executor)
    assert sorted(seed_of(event.key) for event in events if isinstance(event, TaskDone)) == [
        *range(6)
    ]
    for event in events:
        assert isinstance(event, TaskDone)
        assert isinstance(event.outcome, TrialResult)
        expected = quick(specification(seed_of(event.key)))
        np.testing.assert_array_equal(event.outcome.states, expected.states)
        assert event.run.wall_seconds >= 0.0
        assert event.run.peak_memory_bytes > 2**20
        assert event.run.started <= event.run.ended


@for_all
def test_an_exception_comes_back_with_its_traceback_and_the_rest_runs(make: Make) -> None:
    executor = make(raising)
    executor.submit(tasks(range(5)))
    outcomes = {seed_of(e.key): e.outcome for e in drain(executor) if isinstance(e, TaskDone)}
    trouble = outcomes.pop(BROKEN_SEED)
    assert isinstance(trouble, Failure)
    assert (trouble.type, trouble.message) == ("ZeroDivisionError", "the seed is broken")
    assert "in raising" in trouble.traceback
    assert sorted(outcomes) == [0, 1, 3, 4]


@for_all
def test_waiting_ends_in_time_and_without_work_returns_nothing(make: Make) -> None:
    executor = make(slow)
    assert executor.wait(0.01) == []
    assert executor.pending == 0


@for_all
def test_one_thread_for_each_worker(make: Make) -> None:
    executor = make(report_threads)
    executor.submit(tasks([0]))
    [event] = drain(executor)
    assert isinstance(event, TaskDone)
    assert isinstance(event.outcome, Failure)
    assert event.outcome.message == "1"


@pytest.mark.parametrize("executor", WITH_PROCESSES, indirect=True)
def test_the_chunk_of_a_killed_worker_is_lost_and_the_others_are_not(make: Make) -> None:
    executor = make(deadly)
    for seeds in ([0, 1], [BROKEN_SEED, 3], [4, 5], [6, 7]):
        executor.submit(tasks(seeds))
    events = drain(executor)
    lost = {seed_of(key) for event in events if isinstance(event, WorkerLost) for key in event.keys}
    finished = {seed_of(event.key) for event in events if isinstance(event, TaskDone)}
    assert lost == {BROKEN_SEED, 3}
    assert finished == {0, 1, 4, 5, 6, 7}
    assert not any(event.node_lost for event in events if isinstance(event, WorkerLost))


def test_workers_that_cannot_even_start_are_no_fault_of_a_trial() -> None:
    with LocalExecutor(_unknown_elsewhere(), 1) as executor:
        executor.submit(tasks([0]))
        with pytest.raises(LaunchError, match=r"cannot start \(AttributeError: .*getpid_of_nobody"):
            drain(executor)


def test_a_module_that_hides_one_of_the_standard_library_is_no_reason_to_try_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file of classes that is named as a module that only the workers import."""
    (tmp_path / "queue.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    with LocalExecutor(quick, 1) as executor:
        executor.submit(tasks([0]))
        with pytest.raises(LaunchError, match=r"SimpleQueue.*/queue\.py hides the module queue"):
            drain(executor)


def test_what_a_worker_prints_before_it_is_ready_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sitecustomize.py").write_text("import sys; sys.stderr.write('hear me\\n')")
    monkeypatch.syspath_prepend(tmp_path)
    with LocalExecutor(quick, 1) as executor:
        executor.submit(tasks([0]))
        assert len(drain(executor)) == 1
    assert "hear me" in capfd.readouterr().err


@pytest.mark.parametrize("code", [errno.ENOENT, errno.E2BIG])
def test_what_another_launch_cannot_mend_is_not_tried_again(
    code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(subprocess, "Popen", refuse)
    with pytest.raises(OSError, match=os.strerror(code)) as refused, LocalExecutor(quick, 1):
        pass
    assert exit_code(refused.value) == ExitCode.BAD_REQUEST


def _unknown_elsewhere() -> Run:
    """Return a function that pickles by a name which no other process knows."""

    def run(spec: TrialSpec) -> TrialResult:
        raise AssertionError(spec)

    run.__module__, run.__qualname__ = "os", "getpid_of_nobody"
    vars(os)["getpid_of_nobody"] = run
    return run


def test_a_pool_that_cannot_start_all_its_workers_keeps_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    started: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen

    def refuse_the_second(*words: Any, **options: Any) -> subprocess.Popen[bytes]:
        if started:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        started.append(start(*words, **options))
        return started[0]

    monkeypatch.setattr(subprocess, "Popen", refuse_the_second)
    with (
        pytest.raises(InfrastructureError, match=r"temporarily unavailable\): set launch\.workers"),
        LocalExecutor(quick, 2),
    ):
        pass
    assert started[0].poll() == -signal.SIGKILL


def test_a_worker_of_the_local_executor_loads_no_heavy_library() -> None:
    with LocalExecutor(report_modules, workers=1) as executor:
        executor.submit(tasks([0]))
        [done] = drain(executor)
    assert isinstance(done, TaskDone)
    assert isinstance(done.outcome, Failure)
    loaded = set(done.outcome.message.split())
    assert loaded >= {"numba", "numpy"}
    assert not loaded & {"torch", "pandas", "sqlalchemy", "hydra", "omegaconf", "matplotlib", "ray"}
