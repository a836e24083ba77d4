"""Faults of the processes that run trials, and trials that end their process."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

import pytest

from tests.orchestrate.faults.laboratory import Laboratory, Launched, alive, children, command_line
from tests.orchestrate.faults.trials import BROKEN_SEED
from tests.waiting import until

At = Callable[..., Laboratory]

RAY = pytest.mark.xdist_group("ray")

LOST = (
    "status IN ('pending', 'running') AND trial_id IN "
    "(SELECT trial_id FROM attempt WHERE outcome = 'released')"
)
"""Trials that a killed worker held, and that have not run again."""


def test_killed_workers_cost_nothing(sqlite_url: str, laboratory_at: At) -> None:
    """No trial is there twice when its worker dies alone, which would make a failed one of it."""
    laboratory = laboratory_at(sqlite_url, trials=120)
    gate = laboratory.gate

    def nothing_is_lost() -> bool:
        """Return whether both workers wait, and none for a trial of a killed one; let it run."""
        waiting = gate.waiting()
        both = len(waiting) == 2 and set(waiting) == set(launched.workers())
        if lost := both and laboratory.count(LOST):
            gate.let(2)
        return both and not lost

    gate.let(5)
    with laboratory.launched() as launched:
        for in_the_flow in (False, True, True):
            launched.until(nothing_is_lost)
            victim = gate.waiting()[0]
            if in_the_flow:
                gate.let(5)
            os.kill(victim, signal.SIGKILL)
            until(lambda victim=victim: not alive(victim))  # type: ignore[misc]
            gate.let(5)
        gate.open()
        launched.ends()
    laboratory.check()
    ends = laboratory.query("SELECT DISTINCT outcome, cause FROM attempt")
    assert set(ends) == {("done", None), ("diverged", None), ("released", "killed")}


def test_all_workers_killed_at_once_cost_nothing(sqlite_url: str, laboratory_at: At) -> None:
    laboratory = laboratory_at(sqlite_url)
    laboratory.gate.let(10)
    with laboratory.launched() as launched:
        launched.until(lambda: len(laboratory.gate.waiting()) == 2)
        assert set(launched.workers()) == set(laboratory.gate.waiting())
        for worker in launched.workers():
            os.kill(worker, signal.SIGKILL)
        laboratory.gate.open()
        launched.ends()
    laboratory.check()


TROUBLES = {
    "kill": ("killed", {}),
    "hang": ("timeout", {"timeout": 10}),
    "memory": ("out of memory", {"memory_gib": 1}),
}


@pytest.mark.parametrize(
    ("database", "executor", "trouble"),
    [
        ("sqlite", "local", "kill"),
        ("postgresql", "local", "kill"),
        ("sqlite", "local", "hang"),
        ("sqlite", "local", "memory"),
        pytest.param("sqlite", "ray", "kill", marks=RAY),
        pytest.param("sqlite", "ray", "hang", marks=RAY),
    ],
)
def test_a_troubled_trial_fails_alone_and_a_retry_completes(
    request: pytest.FixtureRequest,
    laboratory_at: At,
    database: str,
    executor: str,
    trouble: str,
) -> None:
    cause, settings = TROUBLES[trouble]
    url = request.getfixturevalue(f"{database}_url")
    laboratory = laboratory_at(url, executor=executor, settings=settings, seconds=0.02)
    laboratory.run(1, "1 failed", trouble=trouble)
    laboratory.check(but=BROKEN_SEED)
    assert laboratory.query("SELECT seed, status, cause FROM v_failures") == [
        (BROKEN_SEED, "failed", cause)
    ]
    assert laboratory.count(f"attempt > 2 AND seed <> {BROKEN_SEED}") == 0
    ends = laboratory.query(
        "SELECT a.outcome, a.cause FROM attempt a JOIN trial r ON r.trial_id = a.trial_id "
        f"WHERE r.seed = {BROKEN_SEED} ORDER BY a.attempt"
    )
    # Two deaths alone, and one in a chunk unless it was alone from the start.
    assert len(ends) in ((2, 3) if trouble == "kill" else (1,))
    assert ends == [("released", cause)] * (len(ends) - 1) + [("failed", cause)]
    laboratory.run(1, "nothing to run")
    laboratory.complete(settings={**settings, "retry": "failed"}, executor="inprocess")


def part(launched: Launched, name: str) -> int:
    """Return the process of Ray's that has the name, a child of the driver."""
    [pid] = [pid for pid in launched.workers() if f"/{name} " in command_line(pid)]
    return pid


@RAY
def test_a_killed_worker_of_ray_costs_nothing(sqlite_url: str, laboratory_at: At) -> None:
    laboratory = laboratory_at(sqlite_url, executor="ray")
    laboratory.gate.let(10)
    with laboratory.launched() as launched:
        launched.until(laboratory.gate.waiting)
        victim = laboratory.gate.waiting()[0]
        assert victim in children(part(launched, "raylet"))
        assert command_line(victim).startswith("ray::run_chunk")
        os.kill(victim, signal.SIGKILL)
        laboratory.gate.open()
        launched.ends()
    laboratory.check()


@RAY
@pytest.mark.parametrize("name", ["raylet", "gcs_server"])
def test_the_end_of_ray_frees_the_claims_and_a_rerun_completes(
    sqlite_url: str, laboratory_at: At, name: str
) -> None:
    laboratory = laboratory_at(sqlite_url, executor="ray")
    laboratory.gate.let(20)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 5)
        processes = launched.workers()
        os.kill(part(launched, name), signal.SIGKILL)
        launched.ends(75, f"error: Ray's {name} has ended")
    until(lambda: not any(map(alive, processes)))
    assert laboratory.count("status = 'running'") == 0
    assert laboratory.count("status = 'failed'") == 0
    laboratory.check_whole()
    laboratory.complete(executor="inprocess")
