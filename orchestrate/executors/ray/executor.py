"""Executor on Ray: the cores of this machine, or of a cluster given by its address.

The machines of a cluster may join and leave. Without its head it continues for a while and then
ends the launch with no Python exception; the watch detects the loss before that. A query may block
for any time, so that a thread sends it, and the launch only reads the last answer.
"""

from __future__ import annotations

import importlib
import logging
import os
import platform
import re
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ray
from ray import cloudpickle, exceptions
from ray._private import services
from ray.job_config import JobConfig

from dopt.errors import DoptError
from dopt.process import usable_cores
from orchestrate import fingerprint as alike
from orchestrate.errors import InfrastructureError, LaunchError
from orchestrate.executors.base import (
    Event,
    Executor,
    Prepare,
    Run,
    Task,
    TaskDone,
    WorkerLost,
    run_task,
)
from orchestrate.executors.limits import (
    NO_LIMITS,
    ONE_THREAD,
    Limits,
    ended_after,
    limit_memory,
    module_path,
    pin_threads,
)
from orchestrate.fingerprint import Fingerprint, fingerprint
from orchestrate.program import exit_code

TASK_OPTIONS: dict[str, Any] = {"num_cpus": 1, "max_retries": 0, "num_returns": "streaming"}
"""One core for each chunk; Ray never repeats it, and streams its outcomes."""

_TOKEN = "RAY_AUTH_TOKEN"


def _init(address: str, **options: Any) -> None:
    """Connect to Ray, or raise ``InfrastructureError``, or ``LaunchError`` where none can start."""
    if ray.is_initialized():
        ray.shutdown()  # the rest of a lost connection
    # Ray prints more than a hundred lines, such as a memory map, for a lost node.
    ray._private.worker.print_to_stdstream = lambda *_, **__: None
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **options)
    except Exception as error:
        raise unreachable(address, error) from None


def unreachable(address: str, error: Exception) -> DoptError:
    """Return the error for a failed connection to Ray."""
    wait = isinstance(error, ConnectionError | TimeoutError) or exit_code(error) != 2
    if address == "local" and isinstance(error, OSError) and not wait:
        return LaunchError(
            f"Ray cannot start ({first_line(error)}): set RAY_TMPDIR, or TMPDIR, to a folder with "
            "a short path that can be written, such as /tmp, or use executor=local."
        )
    return InfrastructureError(
        f"Ray cannot be reached at '{address}' ({first_line(error)}): check launch.ray.address, "
        "or use executor=local."
    )


def first_line(error: Exception) -> str:
    """Return the first line of a Ray error, without the authentication token."""
    lines = str(error).strip().splitlines()
    line = lines[0] if lines else type(error).__name__
    token = os.environ.get(_TOKEN)
    return line.replace(token, "***") if token else line


_STDERR = 2  # Ray writes it to a log file of the worker on its node


def run_chunk(
    run: Run, tasks: list[Task], limits: Limits, prepare: Prepare | None = None
) -> Iterator[TaskDone | None]:
    """Run tasks in order; yield None when the first begins, then each outcome as it ends.

    ``prepare`` is called first, on machines where the launch has not called it.
    """
    pin_threads()
    if prepare:
        prepare()
    yield None
    for task in tasks:
        limit_memory(limits, task.memory_factor)
        with ended_after(limits, _STDERR):
            finished = run_task(run, task, limits)
        yield finished


OBJECT_STORE_BYTES = 256 * 2**20
"""Size of the store for outcomes in transfer; by default Ray takes a third of the memory."""


class OwnRay:
    """Ray with ``workers`` processes, by default one on each core."""

    limit: int | None = None
    """Largest number of chunks submitted to Ray at once; None for no limit."""

    def __init__(self, workers: int | None) -> None:
        self.slots = workers or usable_cores()

    def connect(self) -> None:
        # Workers inherit this environment, which is seconds faster than a runtime environment.
        os.environ.update({**ONE_THREAD, **module_path()})
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        start(self._start)
        self._task: Any = ray.remote(**TASK_OPTIONS)(run_chunk)

    def _start(self) -> None:
        _init(
            "local",
            num_cpus=self.slots,
            object_store_memory=OBJECT_STORE_BYTES,
            include_dashboard=False,
            # Of a client's job Ray's workers look for no modules in the working folder.
            job_config=JobConfig(_client_job=True),
        )

    def run(self, run: Run, tasks: list[Task], limits: Limits) -> Any:
        """Start a chunk and return the stream of its outcomes."""
        return self._task.remote(run, tasks, limits, None)

    def check(self) -> None:
        """Raise ``InfrastructureError`` if Ray is lost, which Ray notices after a minute."""
        node: Any = ray._private.worker._global_node
        if node is None:
            return
        dead = {kind for kind, _ in node.dead_processes()} & {"gcs_server", "raylet"}
        if dead:
            raise InfrastructureError(
                f"Ray's {' and '.join(sorted(dead))} has ended: run the same command again "
                "to continue."
            )

    def disconnect(self, *, lost: bool) -> None:  # noqa: ARG002  # there is always a process to end
        """Disconnect from Ray, which does not answer any more if it is ``lost``."""
        ray.shutdown()


START_SECONDS = 120.0
"""Time for Ray's processes to start; Ray itself waits for 30 s, which a busy machine exceeds."""

ATTEMPTS = 2


def start(begin: Callable[[], None]) -> None:
    """Call ``begin``, which starts Ray, and once more if it fails.

    Raises ``InfrastructureError`` with the last reason and the load of the machine, and at once
    what is no ``InfrastructureError``.
    """
    for attempt in range(1, ATTEMPTS + 1):
        before = _children()
        try:
            with _long_start():
                begin()
            return
        except DoptError as error:
            for process in _children() - before:  # they would keep the cores busy
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
            if not isinstance(error, InfrastructureError):
                raise
            if attempt == ATTEMPTS:
                raise InfrastructureError(
                    f"{error} It was tried {ATTEMPTS} times; the load is {os.getloadavg()[0]:.1f} "
                    f"on {usable_cores()} cores: run the same command again when fewer programs "
                    "run."
                ) from error


@contextmanager
def _long_start() -> Iterator[None]:
    """Let Ray wait for its own node for ``START_SECONDS``: the limit of Ray is a constant in it."""
    query = services.get_node

    def patient(*arguments: Any, **options: Any) -> Any:
        end = time.monotonic() + START_SECONDS
        while True:
            try:
                return query(*arguments, **options)  # type: ignore[no-untyped-call]
            except RuntimeError:
                if time.monotonic() > end or not _raylet_lives():
                    raise

    services.get_node = patient
    try:
        yield
    finally:
        services.get_node = query


def _children() -> set[int]:
    """Return the process ids of the children of this process."""
    found: set[int] = set()
    for thread in Path("/proc/self/task").iterdir():
        with suppress(OSError):  # the thread may end at this moment
            found |= {int(number) for number in (thread / "children").read_text().split()}
    return found


def _raylet_lives() -> bool:
    """Return True if a raylet that this process has started has not ended."""
    for process in _children():
        with suppress(OSError):  # it may end at this moment
            status = Path(f"/proc/{process}/status").read_text()
            name, state = re.findall(r"^(?:Name|State):\s+(\S+)", status, re.MULTILINE)
            if name == "raylet" and state not in "ZX":
                return True
    return False


CONNECT_SECONDS = 5.0

SETTINGS_FILE = Path(__file__).with_name("ray.env")
_SETTING = "RAY_"
_verified: list[bool] = []  # not empty once this process has compared its fingerprint


class Cluster:
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
        _init(self._address, runtime_env={"env_vars": ONE_THREAD})
        for module in (alike, sys.modules[__name__]):
            cloudpickle.register_pickle_by_value(module)  # type: ignore[no-untyped-call]
        self._task = ray.remote(**TASK_OPTIONS)(run_where_alike)
        self._expected = fingerprint(setting_names())
        self._watch = ClusterWatch(ray.get_runtime_context().gcs_address)

    @property
    def slots(self) -> int:
        """Number of tasks that run at the same time, now."""
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
    :func:`orchestrate.executors.ray.executor.run_chunk`, whose outcomes are yielded.

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
    chunk = importlib.import_module("orchestrate.executors.ray.executor")
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
            with suppress(Exception):  # any error means "no answer"
                # Ray itself would wait for a lost head.
                socket.create_connection((host, int(port)), QUERY_INTERVAL_SECONDS).close()
                nodes = ray.nodes()  # type: ignore[no-untyped-call]
                alive = (node["Resources"] for node in nodes if node["Alive"])
                self.cores = int(sum(one.get("CPU", 0) for one in alive))
                self._answers += 1
            self._over.wait(QUERY_INTERVAL_SECONDS)


_WORKER_LOST = (exceptions.WorkerCrashedError, exceptions.OutOfMemoryError)
_NODE_LOST = (exceptions.NodeDiedError, exceptions.ObjectLostError)

FETCH_SECONDS = 60.0
"""Time limit for fetching an outcome that is ready."""


@dataclass
class Chunk:
    """Unfinished tasks of a chunk, and the time [s] of its last message; None before its start."""

    tasks: deque[Task]
    last_message: float | None = None


class RayExecutor(Executor):
    """Runs each chunk as one Ray task, which Ray never repeats.

    Parameters
    ----------
    run
        Function that runs a trial.
    workers
        Number of simultaneous tasks; by default one on each core of the machine or cluster.
    address
        ``"local"`` starts a private Ray instance; HOST:PORT joins a cluster.
    limits
        Limits of a trial and of a worker.
    prepare
        Function that each machine of a cluster calls before its first trial.
    """

    def __init__(
        self,
        run: Run,
        workers: int | None = None,
        address: str = "local",
        limits: Limits = NO_LIMITS,
        prepare: Prepare | None = None,
    ) -> None:
        self._run = run
        self._limits = limits
        self._ray: OwnRay | Cluster = (
            OwnRay(workers) if address == "local" else Cluster(address, workers, prepare)
        )
        self._queue: deque[Sequence[Task]] = deque()
        self._chunks: dict[Any, Chunk] = {}
        self._lost = False

    def start(self) -> None:
        self._ray.connect()
        self.slots = self._ray.slots

    def submit(self, chunk: Sequence[Task]) -> None:
        if chunk:
            self._queue.append(chunk)
            self._feed()

    def _feed(self) -> None:
        limit = self._ray.limit
        while self._queue and (limit is None or len(self._chunks) < limit):
            chunk = list(self._queue.popleft())
            stream = self._ray.run(self._run, chunk, self._limits)
            self._chunks[stream] = Chunk(deque(chunk))

    def wait(self, timeout: float) -> list[Event]:
        if not self._chunks:
            return []
        events: list[Event] = []
        try:
            self._ray.check()
            ready, _ = ray.wait(list(self._chunks), num_returns=1, timeout=timeout)
            while ready:
                for stream in ready:
                    events += self._take(stream)
                streams = list(self._chunks)
                count = len(streams)
                ready = ray.wait(streams, num_returns=count, timeout=0)[0] if count else []
        except InfrastructureError:
            self._lost = True
            raise
        self.slots = self._ray.slots
        self._feed()
        return events

    @property
    def pending(self) -> int:
        return len(self._chunks) + len(self._queue)

    def stop(self) -> None:
        if not self._lost:
            for stream in self._chunks:
                ray.cancel(stream, force=True)
        self._chunks.clear()
        self._queue.clear()
        self._ray.disconnect(lost=self._lost)

    def _take(self, stream: Any) -> list[Event]:
        """Return the next outcome of a chunk; none if the message says that it has begun."""
        chunk = self._chunks[stream]
        try:
            message: TaskDone | str | None = ray.get(next(stream), timeout=FETCH_SECONDS)
        except StopIteration:
            del self._chunks[stream]
            return []
        except _WORKER_LOST as error:
            self._ray.check()  # workers die with their raylet, which no trial causes
            return self._lose(stream, error)
        except _NODE_LOST as error:
            keys = tuple(task.key for task in self._chunks.pop(stream).tasks)
            address = re.search(r"Node IP: ([\w.:]+)", str(error))
            loss = f"lost with its machine {address[1]}" if address else "lost"
            return [WorkerLost(keys, loss, node_lost=True)] if keys else []
        except exceptions.RayError as error:
            raise InfrastructureError(
                f"Ray failed ({first_line(error)}): run the same command again to continue."
            ) from error
        chunk.last_message = time.monotonic()
        if isinstance(message, TaskDone):
            chunk.tasks.popleft()
            return [message]
        if message is not None:
            raise InfrastructureError(
                f"A node of the Ray cluster would give different numbers: {message}; install one "
                "version on all nodes, start each with orchestrate/executors/ray/ray.env, and run "
                "the same command again."
            )
        return []

    def _lose(self, stream: Any, error: Exception) -> list[Event]:
        """Give up the chunk of a dead worker, or only its task that exceeded the time limit."""
        chunk = self._chunks.pop(stream)
        keys = tuple(task.key for task in chunk.tasks)
        limit, begun = self._limits.seconds, chunk.last_message
        if keys and limit and begun and time.monotonic() - begun > limit:
            self.submit([*chunk.tasks][1:])  # they have not begun
            return [WorkerLost(keys[:1], self._limits.timeout_message, cause="timeout")]
        out_of_memory = isinstance(error, exceptions.OutOfMemoryError)
        cause = "out of memory" if out_of_memory else "killed"
        reason = f"ended unexpectedly ({first_line(error)})"
        return [WorkerLost(keys, reason, cause=cause)] if keys else []
