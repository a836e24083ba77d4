"""Kill -9 of a part of Ray: a worker costs nothing, Ray itself ends the launch and no more."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

import pytest

from tests.orchestrate.faults.laboratory import (
    Laboratory,
    Launched,
    alive,
    children,
    command_line,
)
from tests.waiting import until

pytestmark = pytest.mark.xdist_group("ray")


@pytest.fixture
def laboratory(sqlite_url: str, laboratory_at: Callable[..., Laboratory]) -> Laboratory:
    return laboratory_at(sqlite_url, executor="ray")


def part(launched: Launched, name: str) -> int:
    """Return the process of Ray's that has the name, a child of the driver."""
    [pid] = [pid for pid in launched.workers() if f"/{name} " in command_line(pid)]
    return pid


def test_a_killed_worker_costs_nothing(laboratory: Laboratory) -> None:
    laboratory.gate.let(10)
    with laboratory.launched() as launched:
        launched.until(laboratory.gate.waiting)
        victim = laboratory.gate.waiting()[0]
        assert victim in children(part(launched, "raylet"))
        assert command_line(victim).startswith("ray::run_chunk")
        os.kill(victim, signal.SIGKILL)
        laboratory.gate.open()
        assert launched.end() == 0, launched.errors
    laboratory.check()


@pytest.mark.parametrize(("name", "then"), [("raylet", "ray"), ("gcs_server", "inprocess")])
def test_the_end_of_ray_frees_the_claims_and_a_rerun_completes(
    laboratory: Laboratory, name: str, then: str
) -> None:
    laboratory.gate.let(20)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 5)
        processes = launched.workers()
        os.kill(part(launched, name), signal.SIGKILL)
        assert launched.end() == 75, launched.errors
    assert f"error: Ray's {name} has ended" in launched.errors
    assert launched.errors.count("error:") == 1
    assert "Traceback" not in launched.errors
    until(lambda: not any(map(alive, processes)))
    assert laboratory.count("status = 'running'") == 0
    assert laboratory.count("status = 'failed'") == 0
    laboratory.check_whole()
    laboratory.complete(executor=then)
