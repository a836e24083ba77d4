"""Connection to a running Ray cluster, whose machines may join and leave, and its health.

Without its head a cluster continues for a while and then ends the launch with no Python exception;
the check detects the loss before that. A query may block for any time, so that a thread of its own
sends it, and the launch only reads the last answer.
"""

from __future__ import annotations

import contextlib
import importlib
import platform
import re
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ray
from ray import cloudpickle

from orchestrate import fingerprint as alike
from orchestrate.errors import InfrastructureError, LaunchError
from orchestrate.executors.base import Prepare, Run, Task
from orchestrate.executors.limits import ONE_THREAD, Limits
from orchestrate.executors.ray.connection import TASK_OPTIONS, Connection, unreachable
from orchestrate.fingerprint import Fingerprint, fingerprint

CONNECT_SECONDS = 5.0

SETTINGS_FILE = Path(__file__).with_name("ray.env")
_SETTING = "RAY_"
_verified: list[bool] = []  # not empty once this process has compared its fingerprint


class Cluster(Connection):
    """Cluster with its head at ``address``; ``workers`` limits the cores that are used.

    ``prepare`` is called on every worker before its first trial.
    """

    def __init__(self, address: str, workers: int | None, prepare: Prepare | None) -> None:
        if not re.fullmatch(r"auto|[^/@]+:\d+", address):
            raise LaunchError(
                f"launch.ray.address is '{address}', but local or HOST:PORT of the head of a "
                "cluster is expected: start the launch on a node of the cluster."
            )
        self._address = address
        self._workers = self.limit = workers
        self._prepare = prepare

    def connect(self) -> None:
        self._check_head()
        self._init(self._address, runtime_env={"env_vars": ONE_THREAD})
        for module in (alike, sys.modules[__name__]):
            cloudpickle.register_pickle_by_value(module)  # type: ignore[no-untyped-call]
        self._task = ray.remote(**TASK_OPTIONS)(run_where_alike)
        self._expected = fingerprint(setting_names())
        self._watch = ClusterWatch(ray.get_runtime_context().gcs_address)

    @property
    def slots(self) -> int:
        return self._workers or max(1, self._watch.cores)

    def run(self, run: Run, tasks: list[Task], limits: Limits) -> Any:
        payload = cloudpickle.dumps(  # type: ignore[no-untyped-call]
            (run, tasks, limits, self._prepare)
        )
        return self._task.remote(self._expected, payload)

    def check(self) -> None:
        self._watch.check()

    def disconnect(self, *, lost: bool) -> None:
        self._watch.stop()
        if not lost:  # otherwise it takes seconds, in which the claims stay held
            ray.shutdown()

    def _check_head(self) -> None:
        """Check that the port is open; Ray itself retries for more than two minutes."""
        host, _, port = self._address.rpartition(":")
        if not host:
            return
        try:
            socket.create_connection((host, int(port)), CONNECT_SECONDS).close()
        except OSError as error:
            raise unreachable(self._address, error) from None


def setting_names() -> list[str]:
    """Return the Ray settings that must be equal on all nodes."""
    lines = SETTINGS_FILE.read_text().splitlines()
    return [line.partition("=")[0] for line in lines if line and not line.startswith("#")]


def run_where_alike(expected: Fingerprint, payload: bytes) -> Iterator[Any]:
    """Run a chunk, or yield one clause that names the difference.

    ``payload`` holds the pickled arguments of
    :func:`orchestrate.executors.ray.connection.run_chunk`, whose outcomes are yielded.

    Ray finds a function on a worker by its name, in the code installed there. This one and what it
    calls are pickled by value instead: they run before any module of this project is imported on
    the worker. Sending all of the code was measured to be no slower (2 s to the first result either
    way), but compiled code is cached by the path of its sources, and Ray unpacks code into a new
    folder for each session, which would compile for a minute.
    """
    if not _verified:
        found = fingerprint([name for name in expected if name.startswith(_SETTING)])
        for name, value in expected.items():
            if found[name] != value:
                yield f"on node {platform.node()} the {name} is {found[name]}, here it is {value}"
                return
        _verified.append(True)
    chunk = importlib.import_module("orchestrate.executors.ray.connection")
    yield from chunk.run_chunk(*cloudpickle.loads(payload))


QUERY_INTERVAL_SECONDS = 1.0
HEAD_TIMEOUT_SECONDS = 3.0
"""Time without an answer after which the head is lost; Ray ended launches after 5 s."""

NO_CORES_TIMEOUT_SECONDS = 60.0
"""Time for which a cluster may have no cores."""


class ClusterWatch:
    """Thread that queries the head at ``address``, HOST:PORT.

    Attributes
    ----------
    cores : int
        Cores of the living nodes at the last answer.
    """

    def __init__(self, address: str) -> None:
        self.cores = 0
        self._address = address
        self._answers = 0
        self._heard = 0
        self._silence = 0.0
        self._no_cores_since = self._checked = time.monotonic()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._ask, name="cluster watch", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raise ``InfrastructureError`` if the head does not answer, or all nodes are gone."""
        now = time.monotonic()
        # A launch that was itself suspended got no answers either: its pause does not count.
        self._silence += min(now - self._checked, QUERY_INTERVAL_SECONDS / 2)
        self._checked = now
        if self._answers != self._heard:
            self._heard, self._silence = self._answers, 0.0
        if self._silence > HEAD_TIMEOUT_SECONDS:
            raise InfrastructureError(
                f"The head of the Ray cluster at {self._address} has not answered for "
                f"{HEAD_TIMEOUT_SECONDS:.0f} s: when it is back, run the same command again to "
                "continue."
            )
        if self.cores:
            self._no_cores_since = now
        if now - self._no_cores_since > NO_CORES_TIMEOUT_SECONDS:
            raise InfrastructureError(
                f"The Ray cluster at {self._address} has had no cores for "
                f"{NO_CORES_TIMEOUT_SECONDS:.0f} s: start nodes that join it, and run the same "
                "command again to continue."
            )

    def stop(self) -> None:
        """Stop the thread."""
        self._over.set()
        self._thread.join(timeout=QUERY_INTERVAL_SECONDS)

    def _ask(self) -> None:
        host, port = self._address.rsplit(":", 1)
        while not self._over.is_set():
            with contextlib.suppress(Exception):  # any error means "no answer"
                # Ray itself would wait for a lost head.
                socket.create_connection((host, int(port)), QUERY_INTERVAL_SECONDS).close()
                self.cores = _cores()
                self._answers += 1
            self._over.wait(QUERY_INTERVAL_SECONDS)


def _cores() -> int:
    nodes = ray.nodes()  # type: ignore[no-untyped-call]
    return int(sum(node["Resources"].get("CPU", 0) for node in nodes if node["Alive"]))
