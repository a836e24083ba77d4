"""Faults of the driver: kill -9, Ctrl-C, a sleep past the lease, a clock that jumps."""

from __future__ import annotations

import os
import random
import re
import signal
import sqlite3
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
from sqlalchemy.engine import make_url

from orchestrate.runner import progress
from orchestrate.runner.progress import FINISHING, Interrupt, undisturbed
from tests.orchestrate.faults.laboratory import Laboratory, Launched, alive, stands_still
from tests.waiting import PATIENCE_SECONDS, until

At = Callable[..., Laboratory]

KILLS = 15
LONGEST_SECONDS = 0.4
TRIALS = 400


@pytest.mark.parametrize(("pause", "done"), [("claim", 0), ("commit", 2)])
def test_death_at_a_chosen_moment(laboratory: Laboratory, pause: str, done: int) -> None:
    with laboratory.launched(pause=pause, executor="inprocess") as launched:
        launched.until(lambda: launched.paused)
        launched.kill()
    assert laboratory.count() == done
    assert laboratory.count("true") == laboratory.order.trials
    laboratory.check_whole()
    laboratory.end_lease(launched)
    laboratory.complete()


@pytest.mark.parametrize(
    ("database", "executor"),
    [
        ("sqlite", "local"),
        ("postgresql", "local"),
        pytest.param("sqlite", "ray", marks=pytest.mark.xdist_group("ray")),
    ],
)
def test_death_in_mid_run_leaves_whole_trials_and_no_process(
    request: pytest.FixtureRequest, laboratory_at: At, database: str, executor: str
) -> None:
    laboratory = laboratory_at(request.getfixturevalue(f"{database}_url"), executor=executor)
    laboratory.gate.let(20)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 5)
        workers = launched.workers()
        assert len(workers) >= 2
        launched.kill()
    until(lambda: not any(map(alive, workers)))
    before = laboratory.count()
    assert 5 <= before < laboratory.order.trials
    laboratory.check_whole()
    laboratory.end_lease(launched)
    said = laboratory.complete(executor="inprocess")
    assert f"{before} of {laboratory.order.trials} already done" in said


def test_death_at_many_random_moments(url: str, laboratory_at: At) -> None:
    laboratory = laboratory_at(url, TRIALS, seconds=0.003, executor="inprocess")
    moments, done = random.Random(0), [0]
    while len(done) <= KILLS and done[-1] < TRIALS:
        laboratory.gate.let(30)
        with laboratory.launched() as launched:
            if len(done) % 2:  # at work in any case, and before anything in the others
                launched.until(lambda: laboratory.count() > done[-1])
            time.sleep(moments.uniform(0.0, LONGEST_SECONDS))
            launched.kill()
        laboratory.end_lease(launched)
        done.append(laboratory.count())
    assert done == sorted(done), "what was committed is lost"
    assert sum(before < after for before, after in pairwise(done)) > 3, "none was killed at work"
    laboratory.check_whole()
    laboratory.complete()


@pytest.mark.parametrize("executor", ["local", "inprocess"])
def test_of_several_launches_none_runs_a_trial_twice(laboratory: Laboratory, executor: str) -> None:
    """They share a database that none of them has made yet."""
    with ExitStack() as stack:
        started = [
            stack.enter_context(laboratory.launched(executor=executor))
            for _ in range(2 if executor == "local" else 8)
        ]
        for launched in started:
            launched.ends(0, f"{laboratory.order.trials} of {laboratory.order.trials}")
    laboratory.check()
    assert laboratory.count("attempt > 1") == 0
    assert laboratory.query("SELECT DISTINCT state FROM launch") == [("done",)]


def interrupt(launched: Launched, number: signal.Signals = signal.SIGINT) -> None:
    """Send a signal, and wait until the launch has heard it: two at once would be one."""
    launched.send(number)
    launched.until(lambda: FINISHING in launched.errors)


@pytest.mark.parametrize(
    ("database", "number"), [("sqlite", signal.SIGINT), ("postgresql", signal.SIGTERM)]
)
def test_one_interrupt_ends_what_runs_and_frees_the_rest(
    request: pytest.FixtureRequest, laboratory_at: At, database: str, number: signal.Signals
) -> None:
    laboratory = laboratory_at(request.getfixturevalue(f"{database}_url"))
    laboratory.gate.let(20)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 5)
        interrupt(launched, number)
        laboratory.gate.open()
        launched.ends(130, "run the same command again to continue")
    left = laboratory.order.trials - laboratory.count()
    assert left > 0
    assert laboratory.count("status = 'pending'") == left
    laboratory.check_whole()
    laboratory.complete()


def test_two_interrupts_stop_at_once_and_lose_nothing_committed(laboratory: Laboratory) -> None:
    laboratory.gate.let(20)
    with laboratory.launched() as launched:
        launched.until(lambda: len(laboratory.gate.waiting()) == 2)  # one interrupt ends none
        launched.until(lambda: laboratory.count() >= 5)
        workers = launched.workers()
        assert len(workers) == 2
        interrupt(launched)
        launched.send(signal.SIGINT)
        launched.ends(130)
    assert not any(map(alive, workers))
    assert laboratory.count() >= 5
    assert laboratory.count("status = 'running'") == 0
    laboratory.check_whole()
    laboratory.complete()


@pytest.mark.parametrize("moment", range(8))
def test_two_interrupts_at_any_moment_leave_no_lock(
    sqlite_url: str, laboratory_at: At, moment: int
) -> None:
    """One of ten of them came in the middle of a transaction, whose lock then stayed.

    One trial never ends: without the second interrupt the launch does not either.
    """
    laboratory = laboratory_at(sqlite_url, 600, seconds=0.005, trouble="hang")
    chance = random.Random(moment)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 20)
        time.sleep(chance.uniform(0, 1))
        interrupt(launched)
        time.sleep(chance.uniform(0.02, 0.15))
        launched.send(signal.SIGINT)
        launched.ends(130)
    assert laboratory.count("status = 'running'") == 0


def test_a_signal_that_is_passed_on_counts_once_and_a_second_ctrl_c_counts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: 100.0))
    with Interrupt((signal.SIGTERM, signal.SIGUSR1, signal.SIGINT)) as stop:
        for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGTERM):
            os.kill(os.getpid(), number)
        assert stop.stop_requested
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def interrupted(times: int, went_on: list[int], rest: float = 0.0) -> None:
    """Be interrupted so many times in the middle of a transaction, and tell when it went on."""
    with undisturbed():
        for _ in range(times):
            os.kill(os.getpid(), signal.SIGINT)
        time.sleep(rest)
        went_on.append(times)


def test_an_interrupt_waits_for_the_end_of_a_transaction() -> None:
    went_on: list[int] = []
    with Interrupt() as stop:
        interrupted(1, went_on)
        assert stop.stop_requested
        with pytest.raises(KeyboardInterrupt):
            interrupted(1, went_on, rest=0.3)
    assert went_on == [1, 1]


def test_a_third_interrupt_leaves_a_transaction_that_hangs() -> None:
    went_on: list[int] = []
    with Interrupt(), pytest.raises(KeyboardInterrupt):
        interrupted(3, went_on, rest=60.0)
    assert went_on == []


SHORT = {"lease": 3, "patience": PATIENCE_SECONDS}
"""Settings of a sleeper, which is alone while it is awake: nobody is there to use a late beat."""

LOST = "SELECT trial_id FROM attempt WHERE outcome = 'lost'"


def stop_between_transactions(sleeper: Launched, laboratory: Laboratory) -> None:
    """Stop it while it does not hold the lock of the file, for which everybody would wait.

    We hold the lock until all its threads stand: a signal does not end what they ask of the kernel.
    """
    path, patience = str(make_url(laboratory.url).database), PATIENCE_SECONDS
    with closing(sqlite3.connect(path, patience, isolation_level=None)) as connection:
        connection.execute("BEGIN IMMEDIATE")
        sleeper.send(signal.SIGSTOP)
        until(lambda: stands_still(sleeper.pid))


def test_another_launch_takes_over_and_late_results_are_refused(
    postgresql_url: str, laboratory_at: At
) -> None:
    laboratory = laboratory_at(postgresql_url)
    laboratory.gate.let(20)
    with laboratory.launched(settings=SHORT) as sleeper:
        sleeper.until(lambda: laboratory.count() >= 5)
        sleeper.send(signal.SIGSTOP)
        laboratory.complete()
        taken = laboratory.query(LOST)
        assert taken, "nothing was taken from the sleeper"
        sleeper.send(signal.SIGCONT)
        sleeper.ends()
    laboratory.check()
    assert laboratory.query(LOST) == taken
    assert laboratory.query("SELECT DISTINCT launch_id FROM trial WHERE attempt = 2") == [(2,)]


@pytest.mark.parametrize("moment", ["commit", "copy", "pipeline"])
def test_a_sleeper_in_a_transaction_holds_up_nobody(
    postgresql_url: str, laboratory_at: At, moment: str
) -> None:
    laboratory = laboratory_at(postgresql_url)
    with laboratory.launched(pause=moment, executor="inprocess", settings=SHORT) as sleeper:
        sleeper.until(lambda: sleeper.paused)
        sleeper.send(signal.SIGSTOP)
        laboratory.complete()
    assert laboratory.query(LOST)


def test_a_sleeper_keeps_its_claims_where_the_kernel_knows_it(
    sqlite_url: str, laboratory_at: At
) -> None:
    laboratory = laboratory_at(sqlite_url)
    laboratory.gate.let(20)
    with laboratory.launched() as sleeper, laboratory.launched() as other:
        sleeper.until(lambda: set(sleeper.workers()) & set(laboratory.gate.waiting()))
        stop_between_transactions(sleeper, laboratory)
        laboratory.gate.open()
        other.until(lambda: laboratory.count("status = 'pending'") == 0)
        sleeper.send(signal.SIGCONT)
        sleeper.ends()
        other.ends()
    laboratory.check()
    assert laboratory.count("attempt > 1") == 0


@pytest.fixture
def library() -> str:
    found = sorted(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"))
    if found:
        return str(found[0])
    message = "the clock is moved by libfaketime: install Debian's package faketime"
    if os.environ.get("DOPT_REQUIRE_FAKETIME") == "1":
        pytest.fail(message)
    pytest.skip(message)


def test_a_clock_that_jumps_by_hours_loses_nothing_and_nobody_takes_over(
    url: str, laboratory_at: At, library: str, tmp_path: Path
) -> None:
    clock = tmp_path / "clock"
    clock.write_text("+0\n")
    environment = {
        "LD_PRELOAD": library,
        "FAKETIME_TIMESTAMP_FILE": str(clock),
        "FAKETIME_NO_CACHE": "1",
        "DONT_FAKE_MONOTONIC": "1",
    }
    laboratory = laboratory_at(url, executor="inprocess")
    laboratory.gate.let(24)
    with laboratory.launched(environment=environment) as moved, ExitStack() as later:
        for done, jump in zip((3, 10, 17), ("+6h", "-6h", "-2h"), strict=True):
            moved.until(lambda done=done: laboratory.count() >= done)  # type: ignore[misc]
            clock.write_text(f"{jump}\n")
        still = later.enter_context(laboratory.launched())
        laboratory.gate.open()
        moved.ends()
        still.ends()
    laboratory.check()
    assert laboratory.count("attempt > 1") == 0
    assert laboratory.count("wall_seconds < 0 OR wall_seconds > 3600") == 0
    rates = [float(rate) for rate in re.findall(r"([\d.-]+)/s", moved.errors)]
    assert rates
    assert all(rate > 0 for rate in rates)
    hours = {ended[11:13] for (ended,) in laboratory.query("SELECT ended FROM attempt")}
    assert len(hours) > 1, "the clock was not moved"
