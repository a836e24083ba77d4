"""One contract, run over every executor; the pool, lockstep and the registry."""

from __future__ import annotations

import ast
import errno
import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.errors import ExitCode, InfrastructureError, LaunchError
from orchestrate.executors.base import (
    EXECUTORS,
    Event,
    Executor,
    InProcessExecutor,
    Run,
    Task,
    TaskDone,
    WorkerLost,
)
from orchestrate.executors.local import LocalExecutor
from orchestrate.executors.lockstep import LockstepExecutor
from orchestrate.program import exit_code
from orchestrate.records import Failure
from orchestrate.store import Reader
from tests.dopt.trials import trial
from tests.orchestrate.executors.conftest import ALL, WITH_PROCESSES, WORKERS
from tests.orchestrate.loaded_modules import report_modules
from tests.orchestrate.standins import BROKEN_SEED, deadly, quick, raising, slow, specification
from tests.paths import ROOT, ran
from tests.waiting import until

Make = Callable[[Run], Executor]
CommandLine = Callable[..., tuple[int, str, str]]

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


def new(name: str, run: Run, **given: Any) -> Executor:
    if name == "inprocess":
        return InProcessExecutor(run)
    if name == "local":
        return LocalExecutor(run, **{"workers": WORKERS, **given})
    ray = importlib.import_module("orchestrate.executors.ray.executor")
    return ray.RayExecutor(run, **{"workers": WORKERS, **given})  # type: ignore[no-any-return]


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


@pytest.mark.parametrize(
    ("policies", "kind"), [(["random"] * 2, TrialResult), (["d_optimal", "random"], Failure)]
)
def test_what_cannot_run_together_is_every_trials_trouble(policies: list[str], kind: type) -> None:
    specs = [trial("pendulum", one, seed) for seed, one in enumerate(policies)]
    with LockstepExecutor("cpu", batch=len(specs)) as executor:
        executor.submit([Task(spec.trial_key, spec) for spec in specs])
        events = executor.wait(0.1)
        assert executor.pending == 0
    assert [event.key for event in events if isinstance(event, TaskDone)] == [
        spec.trial_key for spec in specs
    ]
    assert all(isinstance(event.outcome, kind) for event in events)


@pytest.mark.parametrize("device", ["cpu", "cuda:0"])
def test_a_grid_runs_in_lockstep(command_line: CommandLine, tmp_path: Path, device: str) -> None:
    import torch  # not here for the workers, which import this module

    if device != "cpu" and not torch.cuda.is_available():
        pytest.skip("no CUDA device on this machine")
    url = f"sqlite:///{tmp_path / 'results.db'}"
    grid = ("-m", "env=pendulum", "policy=random,d_optimal", "seed=range(4)", "env.horizon=6")
    words = ("executor=lockstep", "executor.batch=3", f"executor.device={device}")
    code, _, errors = command_line(*grid, *words, f"store.url={url}")
    assert code == 0, errors
    with Reader.open(url) as reader:
        assert [config.n_done for config in reader.configs()] == [4, 4]


def test_lockstep_and_the_kernel_keep_their_trials_apart(
    command_line: CommandLine, tmp_path: Path
) -> None:
    """Their numbers agree to rounding only: one must not be taken for the other."""
    url = f"sqlite:///{tmp_path / 'results.db'}"
    one = ("env=pendulum", "policy=oracle", "seed=1", "env.horizon=6", f"store.url={url}")
    assert command_line(*one, "executor=lockstep")[0] == 0
    assert command_line(*one, "executor=inprocess")[0] == 0
    with Reader.open(url) as reader:
        found = sorted(str(config.config["path"]) for config in reader.configs())
        assert found == ["kernel", "reference"]


LAUNCH = """
import json, sys
from orchestrate.runner import start
from orchestrate import launch
from orchestrate.runner.start import Work
from tests.orchestrate.standins import quick

if __name__ == "__main__":
    start.WORK = Work(quick)
    code = launch.main()
    print(json.dumps([code, sorted({"ray", "torch"} & set(sys.modules))]))
"""


def test_each_executor_has_a_configuration_file() -> None:
    files = {path.stem for path in (ROOT / "conf" / "executor").glob("*.yaml")}
    assert files == set(EXECUTORS)


@pytest.mark.parametrize("name", ["local", "lockstep", "ray"])
def test_an_executor_is_named_in_its_own_files_and_the_registry_only(name: str) -> None:
    module = f"orchestrate.executors.{name}"
    own = {f"orchestrate/executors/{name}.py", "orchestrate/executors/base.py"}
    for path in (ROOT / "orchestrate").rglob("*.py"):
        file = str(path.relative_to(ROOT))
        if file in own or file.startswith(f"orchestrate/executors/{name}/"):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert not str(node.module).startswith(module), file
            if isinstance(node, ast.Compare):
                values = [one.value for one in node.comparators if isinstance(one, ast.Constant)]
                assert name not in values or (name == "local" and "ray" in file), file


MINE = """
from orchestrate.executors.base import InProcessExecutor
from orchestrate.executors.base import ExecutorFactory

given = []

def make(settings, run, _):
    given.append(settings.executor_options["nice"])
    return InProcessExecutor(run)

FACTORY = ExecutorFactory(make, lambda _: 1)
"""


def test_a_new_executor_needs_a_module_a_file_and_an_entry(
    command_line: CommandLine, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "my_executor.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(EXECUTORS, "mine", "my_executor")  # type: ignore[arg-type]
    (tmp_path / "conf" / "executor").mkdir(parents=True)
    (tmp_path / "conf" / "executor" / "mine.yaml").write_text("name: mine\nnice: 5\n")
    code, output, errors = command_line(
        *("-m", "env.horizon=5", "policy=random", "seed=0,1", "executor=mine", "executor.nice=7"),
        f"hydra.searchpath=[file://{tmp_path / 'conf'}]",
    )
    assert (code, sys.modules.pop("my_executor").given) == (0, [7]), errors
    assert "2 to run with executor=mine" in output


def test_local_processes_load_neither_ray_nor_torch(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(LAUNCH)
    words = ["-m", "env.horizon=5", "policy=random", "seed=0,1", "executor=local"]
    done = ran(program, *words, "launch.workers=1", folder=tmp_path, PYTHONPATH=str(ROOT))
    assert json.loads(done.stdout.splitlines()[-1]) == [0, []], done.stderr
