"""Ray: an instance of the launch, and what is refused of a cluster.

A cluster whose nodes and head are lost is in ``tests/machines/test_cluster.py``.
"""

from __future__ import annotations

import errno
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import ray
from ray._private import services

from orchestrate.errors import InfrastructureError, LaunchError
from orchestrate.executors.base import WorkerLost
from orchestrate.executors.ray import executor as ray_start
from orchestrate.executors.ray.executor import (
    RayExecutor,
    first_line,
    run_where_alike,
    setting_names,
    start,
    unreachable,
)
from orchestrate.fingerprint import fingerprint
from tests.orchestrate.executors.conftest import ON_RAY, WORKERS
from tests.orchestrate.executors.test_executors import drain, seed_of, tasks
from tests.orchestrate.faults.laboratory import children
from tests.orchestrate.lean_ray import leave_services_out
from tests.orchestrate.standins import BROKEN_SEED, quick, slow
from tests.orchestrate.unruly import hanging
from tests.waiting import PATIENCE_SECONDS

pytestmark = ON_RAY  # after the tests that share the instance which this ends


@pytest.mark.usefixtures("shared_ray")
def test_the_end_of_ray_itself_is_no_fault_of_a_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its workers have its number, by which they end with it."""
    executor = RayExecutor(slow, workers=WORKERS)
    executor.start()
    node: Any = ray._private.worker._global_node
    raylet = node.all_processes["raylet"][0].process.pid
    ask = ray.remote(num_cpus=1)(lambda: os.environ["RAY_RAYLET_PID"])
    assert ray.get(ask.remote()) == str(raylet)
    executor.submit(tasks(range(20)))
    os.kill(raylet, signal.SIGKILL)
    with pytest.raises(InfrastructureError, match="Ray's raylet has ended"):
        drain(executor)
    monkeypatch.undo()
    executor.stop()
    assert not ray.is_initialized()


def test_a_launch_without_a_parent_outlives_its_raylet() -> None:
    command = f"{sys.executable} -m tests.orchestrate.orphaned_driver $$ &"
    # The driver holds the pipe too: this returns when both have ended.
    done = subprocess.run(command, shell=True, capture_output=True, text=True)
    assert done.stdout.splitlines()[1:] == [
        "Ray's raylet has ended: run the same command again to continue.",
        "processes of Ray: 0",
        "exit",
    ], done.stderr


def test_a_slow_start_of_ray_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = iter([RuntimeError("not yet"), RuntimeError("not yet"), {"node": 1}])

    def slow_query() -> dict[str, int]:
        answer = next(answers)
        if isinstance(answer, RuntimeError):
            raise answer
        return answer

    monkeypatch.setattr(services, "get_node", slow_query)
    monkeypatch.setattr(ray_start, "_raylet_lives", lambda: True)
    found = []
    start(lambda: found.append(services.get_node()))
    assert found == [{"node": 1}]
    assert services.get_node.__name__ == "slow_query"


@pytest.mark.parametrize("listed", [ray_start._children, lambda: set(children(os.getpid()))])
def test_children_are_listed_while_threads_end(listed: Callable[[], set[int]]) -> None:
    over = threading.Event()

    def start_and_end() -> None:
        while not over.is_set():
            thread = threading.Thread(target=int)
            thread.start()
            thread.join()

    with subprocess.Popen(["/bin/sleep", "600"]) as process, ThreadPoolExecutor(4) as pool:
        threads = [pool.submit(start_and_end) for _ in range(4)]
        try:
            for _ in range(500):
                assert process.pid in listed()
        finally:
            over.set()
            process.kill()
        for thread in threads:
            thread.result()


def test_a_raylet_that_has_ended_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    raylet = tmp_path / "raylet"
    shutil.copy("/bin/sleep", raylet)
    with subprocess.Popen([raylet, "600"]) as process:
        monkeypatch.setattr(ray_start, "_children", lambda: {process.pid})
        try:
            while not ray_start._raylet_lives():  # until the process has its name
                assert process.poll() is None
        finally:
            process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert not ray_start._raylet_lives()  # although nobody has asked for its status

        def no_node() -> None:
            raise RuntimeError("no node")

        monkeypatch.setattr(services, "get_node", no_node)
        with pytest.raises(RuntimeError, match="no node"):
            start(services.get_node)


def test_a_failed_start_of_ray_is_ended_and_tried_once_more() -> None:
    started: list[subprocess.Popen[bytes]] = []

    def fail() -> None:
        started.append(subprocess.Popen(["sleep", "600"]))
        raise InfrastructureError("Ray timed out.")

    with pytest.raises(
        InfrastructureError, match=r"Ray timed out\. It was tried 2 times; the load"
    ):
        start(fail)
    found = [process.wait(PATIENCE_SECONDS) for process in started]
    assert found == [-signal.SIGKILL, -signal.SIGKILL]


@pytest.mark.parametrize("code", [errno.EACCES, errno.ENOSPC, None])
def test_a_folder_that_ray_cannot_use_is_named_and_not_tried_again(code: int | None) -> None:
    """TMPDIR of a job may be too long for the name of a socket."""
    tries: list[int] = []
    reason = "AF_UNIX path length cannot exceed 107 bytes"

    def fail() -> None:
        tries.append(1)
        raise unreachable("local", OSError(code, reason) if code else OSError(reason))

    with pytest.raises(LaunchError, match=f"{reason}.*set RAY_TMPDIR, or TMPDIR"):
        start(fail)
    assert len(tries) == 1
    for error in (TimeoutError("late"), BlockingIOError(errno.EAGAIN, "no process"), ValueError()):
        assert isinstance(unreachable("local", error), InfrastructureError)


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


def test_a_node_of_other_settings_says_so_and_runs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "RAY_health_check_period_ms"
    monkeypatch.setenv(name, "1000")
    expected = fingerprint(setting_names())
    monkeypatch.setenv(name, "2000")
    [difference] = run_where_alike(expected, b"no payload is read")
    assert difference.endswith("period_ms is 2000, here it is 1000")


@pytest.mark.parametrize("address", ["ray://10.0.0.1:10001", "head", "me:secret@head:6379"])
def test_an_address_of_another_kind_is_a_wrong_setting(address: str) -> None:
    with pytest.raises(LaunchError, match="HOST:PORT of the head"):
        RayExecutor(quick, address=address)


def test_that_nothing_answers_at_an_address_is_said_at_once() -> None:
    """Ray itself was seen to try for more than two minutes."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    executor = RayExecutor(quick, address=f"127.0.0.1:{port}")
    with pytest.raises(InfrastructureError, match=f"reached at '127.0.0.1:{port}'.*refused"):
        executor.start()


def test_a_token_is_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_AUTH_TOKEN", "abc123")
    assert first_line(ValueError("wrong token abc123\nmore")) == "wrong token ***"
