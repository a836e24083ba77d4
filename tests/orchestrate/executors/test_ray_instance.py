"""What ends a Ray instance on this machine, or its workers: no fault of a trial."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest
import ray

from orchestrate.errors import InfrastructureError
from orchestrate.executors.base import WorkerLost
from orchestrate.executors.ray.executor import RayExecutor
from tests.orchestrate.executors.names import ON_RAY, WORKERS
from tests.orchestrate.executors.test_executors import drain, seed_of, tasks
from tests.orchestrate.lean_ray import leave_services_out
from tests.orchestrate.standins import BROKEN_SEED, slow
from tests.orchestrate.unruly import hanging

pytestmark = ON_RAY  # after the tests that share the instance which this ends


@pytest.mark.usefixtures("shared_ray")
def test_the_end_of_ray_itself_is_no_fault_of_a_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    executor = RayExecutor(slow, workers=WORKERS)
    executor.start()
    node: Any = ray._private.worker._global_node
    executor.submit(tasks(range(20)))
    os.kill(node.all_processes["raylet"][0].process.pid, signal.SIGKILL)
    with pytest.raises(InfrastructureError, match="Ray's raylet has ended"):
        drain(executor)
    monkeypatch.undo()
    executor.stop()
    assert not ray.is_initialized()


def test_a_node_that_runs_low_on_memory_is_told_from_a_crash(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("RAY_memory_usage_threshold", "0.0001")
    monkeypatch.setenv("RAY_memory_monitor_refresh_ms", "100")
    leave_services_out()
    with RayExecutor(hanging, 1) as executor:
        executor.submit(tasks([BROKEN_SEED, 3]))
        [lost] = drain(executor)
    assert isinstance(lost, WorkerLost)
    assert (lost.cause, lost.node_lost) == ("out of memory", False)
    assert [seed_of(key) for key in lost.keys] == [BROKEN_SEED, 3]
