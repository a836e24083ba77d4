"""A trial that takes too long, or too much memory, fails by itself and costs no other anything."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dopt.kernel.run import KernelTrial
from dopt.result import TrialResult
from dopt.run import run_trial
from orchestrate.errors import ExitCode
from orchestrate.executors.base import Run, Task, TaskDone, WorkerLost, run_task
from orchestrate.executors.limits import Limits, TrialTimeoutError, interrupted_after
from orchestrate.executors.local import CrashReport
from orchestrate.records import Failure
from tests.dopt.trials import trial
from tests.orchestrate.conftest import Launches
from tests.orchestrate.executors.conftest import ALL, ON_RAY, WITH_PROCESSES
from tests.orchestrate.executors.test_executors import drain, new, seed_of, tasks
from tests.orchestrate.faults.laboratory import alive
from tests.orchestrate.standins import BROKEN_SEED, deadly, exiting, malformed, raising
from tests.orchestrate.unruly import (
    deaf,
    empty,
    faulty,
    greedy,
    greedy_in_a_group,
    hanging,
    wants_a_gigabyte,
)
from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS, until

SEEDS = 6
LIMIT = 5.0
"""Time limit of trials [s], some thousand times the duration of a quick one."""


def failures(launches: Launches) -> list[tuple[object, ...]]:
    return launches.query("SELECT seed, cause, type, message, attempt FROM v_failures")


def only_the_broken_one_failed(launches: Launches) -> bool:
    statuses = launches.statuses()
    return statuses.pop(BROKEN_SEED) == "failed" and set(statuses.values()) == {"done"}


TIMEOUT = {"timeout": LIMIT}
HUNG = ("timeout", "TrialTimeoutError", "timeout after 5 s", 1)
GREEDY = ("out of memory", "MemoryError", "Unable to allocate", 1)
LEFT = ("exception", "SystemExit", "3", 1)
PAIR = {"workers": 2}
"""Processes for which each chunk of so few trials is one trial, which has two attempts alone."""


@pytest.mark.parametrize(
    ("executor", "run", "settings", "ends", "frame"),
    [
        *((name, hanging, TIMEOUT, HUNG, "in wait_for_nothing") for name in ALL[:2]),
        pytest.param("ray", hanging, TIMEOUT, HUNG, "in wait_for_nothing", marks=ON_RAY),
        ("local", deaf, TIMEOUT, HUNG, "in sleep_natively"),  # native code that heeds no signal
        pytest.param("ray", deaf, TIMEOUT, HUNG, "", marks=ON_RAY),
        ("local", greedy, {"memory_gib": 0.5}, GREEDY, "in hoard"),
        pytest.param("ray", greedy, {"memory_gib": 1.0}, GREEDY, "in hoard", marks=ON_RAY),
        ("local", faulty, PAIR, ("killed", "WorkerLost", "killed by signal 11", 2), "in faulty"),
        ("local", deadly, PAIR, ("killed", "WorkerLost", "killed by signal 9", 2), ""),
        ("local", malformed, {}, ("malformed", "InvalidResultError", "", 1), ""),
        ("local", empty, {}, ("malformed", "_NoResultError", "returned NoneType, but a Tr", 1), ""),
        ("inprocess", raising, {}, ("exception", "ZeroDivisionError", "broken", 1), "in raising"),
        ("local", exiting, {}, LEFT, "in exiting"),
        ("inprocess", exiting, {}, LEFT, "in exiting"),
    ],
    indirect=["executor"],
)  # fmt: skip
def test_a_trial_fails_alone_with_its_cause_and_says_where(
    launches: Launches,
    executor: str,
    run: Run,
    settings: dict[str, float],
    ends: tuple[str, str, str, int],
    frame: str,
) -> None:
    code = launches(run, seeds=SEEDS, executor=executor, **{"workers": 1, **settings})
    assert code == ExitCode.SOME_FAILED
    assert only_the_broken_one_failed(launches)
    [(seed, cause, kind, message, attempt)] = failures(launches)
    assert (seed, cause, attempt) == (BROKEN_SEED, ends[0], ends[3])
    assert ends[1] in str(kind)
    assert ends[2] in str(message)
    released = launches.query("SELECT count(*) FROM attempt WHERE outcome = 'released'")
    assert released == [(attempt - 1,)]
    assert "1 failed: " in launches.said[-1]
    [(text, node, pid)] = launches.query(
        "SELECT v.traceback, a.node, a.pid FROM v_failures v, attempt a WHERE a.outcome = 'failed'"
    )
    assert frame in text
    if "ray" not in executor:
        assert node == socket.gethostname()
        assert pid > 0


@pytest.mark.parametrize("executor", WITH_PROCESSES, indirect=True)
def test_the_rest_of_its_chunk_runs_without_being_charged(executor: str) -> None:
    with new(executor, deaf, workers=1, limits=Limits(seconds=LIMIT)) as kind:
        kind.submit(tasks([0, 1, BROKEN_SEED, 3, 4]))
        events = drain(kind)
    [lost] = [event for event in events if isinstance(event, WorkerLost)]
    assert [seed_of(key) for key in lost.keys] == [BROKEN_SEED]
    assert (lost.cause, lost.reason, lost.node_lost) == ("timeout", "timeout after 5 s", False)
    finished = [event for event in events if isinstance(event, TaskDone)]
    assert [seed_of(event.key) for event in finished] == [0, 1, 3, 4]
    assert all(isinstance(event.outcome, TrialResult) for event in finished)


def test_a_long_trial_of_the_kernel_heeds_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    short, spec = (
        trial("quadrotor", "d_optimal", env={"horizon": steps}, model={"width": 48})
        for steps in (2, 4000)
    )
    run_trial(short)  # what is compiled or loaded on first use comes before the limit
    advance = KernelTrial.advance

    def at_the_limit(kernel: KernelTrial, last: int) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.2)
        advance(kernel, last)

    monkeypatch.setattr(KernelTrial, "advance", at_the_limit)
    limits = Limits(seconds=PATIENCE_SECONDS)
    finished = run_task(run_trial, Task(spec.trial_key, spec), limits)
    assert isinstance(finished.outcome, Failure)
    assert finished.outcome.cause == "timeout"
    assert "in advance" in finished.outcome.traceback


def test_somebody_elses_timer_goes_on() -> None:
    rung: list[int] = []
    handler = signal.signal(signal.SIGALRM, lambda number, _: rung.append(number))
    timer = signal.setitimer(signal.ITIMER_REAL, PATIENCE_SECONDS)
    try:
        with pytest.raises(TrialTimeoutError), interrupted_after(Limits(seconds=0.05)):
            time.sleep(60)
        assert 0.0 < signal.getitimer(signal.ITIMER_REAL)[0] <= PATIENCE_SECONDS
        assert rung == []
        signal.raise_signal(signal.SIGALRM)
        assert rung == [signal.SIGALRM]
    finally:
        signal.signal(signal.SIGALRM, handler)
        signal.setitimer(signal.ITIMER_REAL, *timer)


@pytest.mark.parametrize("executor", WITH_PROCESSES, indirect=True)
def test_a_trial_with_too_little_memory_gets_more_once(launches: Launches, executor: str) -> None:
    """Its process has 0.75 GiB, of which the trial that is greedy wants a half more."""
    settings = {"seeds": SEEDS, "executor": executor, "memory_gib": 0.75, "workers": 1}
    assert launches(wants_a_gigabyte, **settings, retry_memory=1.2) == ExitCode.SOME_FAILED
    assert only_the_broken_one_failed(launches)
    [(_, cause, _, _, attempt)] = failures(launches)
    assert (cause, attempt) == ("out of memory", 2)
    assert launches(wants_a_gigabyte, **settings, retry_memory=4.0, retry="failed") == ExitCode.DONE
    ends = "SELECT attempt, outcome, cause FROM attempt WHERE attempt > 1 ORDER BY attempt"
    expected = [(2, "failed", "out of memory"), (3, "released", "out of memory"), (4, "done", None)]
    assert launches.query(ends) == expected


@pytest.fixture
def small_group(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Make a control group of 600 MiB, where this process may."""
    old = Path("/sys/fs/cgroup/memory")
    group = (old if old.is_dir() else old.parent) / f"dopt-test-{os.getpid()}"
    limit = "memory.limit_in_bytes" if old.is_dir() else "memory.max"
    try:
        group.mkdir()
        (group / limit).write_text(str(600 * 2**20))
    except OSError as error:
        pytest.skip(f"no control group can be made: {error}")
    monkeypatch.setenv("DOPT_TEST_GROUP", str(group))
    yield group
    group.rmdir()


@pytest.mark.usefixtures("small_group")
def test_a_trial_that_the_kernel_kills_for_want_of_memory_fails_after_two_attempts(
    launches: Launches,
) -> None:
    assert launches(greedy_in_a_group, seeds=SEEDS, executor="local") == ExitCode.SOME_FAILED
    assert only_the_broken_one_failed(launches)
    [(_, cause, kind, message, attempt)] = failures(launches)
    assert (cause, kind, attempt) == ("out of memory", "WorkerLost", 2)
    assert "killed by the kernel: out of memory" in str(message)


@pytest.mark.parametrize(
    ("code", "before", "after", "said", "cause"),
    [
        (-9, 3, 3, "", "killed"),
        (-9, 3, 4, "", "out of memory"),
        (-11, 3, 4, "Fatal Python error", "killed"),
        (1, 3, 3, "Timeout (0:00:05)!\nThread", "timeout"),
        (1, 3, 3, "", "killed"),
    ],
)
def test_the_cause_of_an_end(
    code: int, before: int, after: int, said: str, cause: str,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    counts = tmp_path / "vmstat"
    monkeypatch.setattr("orchestrate.executors.local._KERNEL_COUNTERS", counts)
    counts.write_text(f"nr_free_pages 7\noom_kill {before}\n")
    words = CrashReport()
    os.write(words.descriptor, said.encode())
    counts.write_text(f"nr_free_pages 7\noom_kill {after}\n")
    assert words.explain(code).cause == cause


def test_a_worker_that_hears_nothing_ends_with_its_driver() -> None:
    """Its thread cannot notice the end, because the trial holds the interpreter's lock."""
    driver = subprocess.Popen(
        [sys.executable, "-m", "tests.orchestrate.deaf_driver"],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert driver.stdout is not None
    worker = int(driver.stdout.readline())
    driver.kill()
    driver.communicate()
    until(lambda: not alive(worker), lambda: "the worker has outlived its driver")
