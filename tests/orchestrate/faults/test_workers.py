"""Workers that pull: whatever happens to them, each trial is run once, and none fails by it."""

from __future__ import annotations

import os
import random
import signal
from collections.abc import Callable
from contextlib import ExitStack
from types import SimpleNamespace

import pytest

from orchestrate.runner import worker as worker_module
from orchestrate.runner.progress import Interrupt
from orchestrate.runner.scheduler import MAX_WORKER_LOSSES, POLL_SECONDS, SUSPECT_LOSSES
from orchestrate.runner.worker import WARNINGS, Leave
from tests.orchestrate.faults.laboratory import ENDED, Laboratory, Server, preempt
from tests.orchestrate.faults.trials import BROKEN_SEED

At = Callable[..., Laboratory]


def register(laboratory: Laboratory) -> None:
    registered = f"{laboratory.order.trials:,} registered; start workers"
    laboratory.run(0, registered, settings={"detach": True})
    assert laboratory.count("status = 'pending'") == laboratory.order.trials


def test_workers_share_a_grid_and_run_nothing_twice(postgresql_url: str, laboratory_at: At) -> None:
    laboratory = laboratory_at(postgresql_url)
    register(laboratory)
    with ExitStack() as stack:
        workers = [stack.enter_context(laboratory.launched(worker={})) for _ in range(3)]
        for worker in workers:
            worker.ends()
    laboratory.check()
    assert laboratory.count("attempt > 1") == 0


def test_preempted_workers_lose_and_double_nothing(url: str, laboratory_at: At) -> None:
    laboratory = laboratory_at(url, 120, seconds=0.05)
    register(laboratory)
    sent = preempt(laboratory, workers=3, every=12, chance=random.Random(1))
    assert sent.total() >= 2
    laboratory.check()
    assert laboratory.count("status = 'failed'") == 0


@pytest.mark.parametrize(
    ("database", "number"), [("sqlite", signal.SIGTERM), ("postgresql", signal.SIGUSR1)]
)
def test_a_warned_worker_hands_back_what_runs(
    request: pytest.FixtureRequest, laboratory_at: At, database: str, number: signal.Signals
) -> None:
    laboratory = laboratory_at(request.getfixturevalue(f"{database}_url"))
    register(laboratory)
    laboratory.gate.let(0)
    with laboratory.launched(worker={}) as worker:
        worker.until(lambda: len(laboratory.gate.waiting()) == 2)
        for pid in worker.workers():  # as batch systems do, which know nothing of parents
            os.kill(pid, number)
        worker.send(number)
        worker.send(signal.SIGUSR1)  # the shell of a job passes on what all its processes got
        worker.ends(130, "0 trials done")
    assert laboratory.count("status = 'pending'") == laboratory.order.trials
    assert laboratory.query("SELECT DISTINCT outcome, cause FROM attempt") == [("released", None)]


def test_a_warned_worker_waits_two_seconds_for_what_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    now, waited = 100.0, []

    def monotonic() -> float:
        return now

    monkeypatch.setattr(worker_module, "time", SimpleNamespace(monotonic=monotonic))
    with Interrupt(WARNINGS) as interrupt:
        leave = Leave(interrupt, None)
        assert not leave.at_once
        signal.raise_signal(signal.SIGUSR1)
        while not leave.at_once:
            waited.append(now)
            now += POLL_SECONDS
    assert len(waited) * POLL_SECONDS == pytest.approx(2.0)


def test_a_warned_worker_does_not_wait_for_its_database(server: Server, laboratory_at: At) -> None:
    laboratory = laboratory_at(server.new_url())
    register(laboratory)
    laboratory.gate.let(0)
    with laboratory.launched(worker={}) as worker:
        worker.until(laboratory.gate.waiting)
        server.stop()
        try:
            worker.send(signal.SIGTERM)
            assert worker.end() == 75, worker.said
        finally:
            server.start()
    assert "cannot be used" in worker.errors


def test_a_worker_holds_nothing_at_the_end_of_its_time(sqlite_url: str, laboratory_at: At) -> None:
    """By its clock: two trials of .05 s at once, which takes no time for anything else."""
    laboratory = laboratory_at(sqlite_url, 150, seconds=0.05)
    register(laboratory)
    with laboratory.launched(worker={"seconds": 2.5}, tick=0.025) as worker:
        worker.ends(3)
    assert laboratory.gate.passed * 0.025 <= 2.5
    assert laboratory.count() > 0
    assert laboratory.count("status = 'running'") == 0
    assert laboratory.query("SELECT outcome FROM attempt WHERE outcome = 'released'") == []
    laboratory.check_whole()


def test_a_trial_that_kills_its_process_fails_and_stops_no_other(
    sqlite_url: str, laboratory_at: At
) -> None:
    laboratory = laboratory_at(sqlite_url, 20, seconds=0.01, trouble="kill")
    register(laboratory)
    with laboratory.launched(worker={}) as worker:
        worker.ends(1)
    [(seed, attempt, cause)] = laboratory.query("SELECT seed, attempt, cause FROM v_failures")
    assert (seed, cause) == (BROKEN_SEED, "killed")
    assert attempt >= MAX_WORKER_LOSSES
    laboratory.check_whole()


def test_a_trial_that_kills_its_worker_runs_alone_and_stops_in_the_end(
    sqlite_url: str, laboratory_at: At
) -> None:
    """As where a limit of memory ends all processes of a job together."""
    losses = SUSPECT_LOSSES + 2
    laboratory = laboratory_at(
        sqlite_url, 20, seconds=0.01, trouble="kill worker", lone_losses=losses
    )
    register(laboratory)
    codes = []
    while laboratory.count(ENDED) < 20:
        with laboratory.launched(worker={}) as worker:
            codes.append(worker.end())
        assert len(codes) <= 4 * losses, worker.said + worker.errors
    assert codes[:-1] == [-signal.SIGKILL] * (len(codes) - 1)
    assert codes[-1] == 1
    assert len(codes) > losses
    [(seed, cause, message)] = laboratory.query("SELECT seed, cause, message FROM v_failures")
    assert (seed, cause) == (BROKEN_SEED, "node lost")
    assert f"node was lost {losses} times while running only this trial" in message
    assert laboratory.count() == 19
