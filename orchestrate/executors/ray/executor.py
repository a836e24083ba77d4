"""Executor on Ray: the cores of this machine, or of a cluster given by its address."""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import ray
from ray import exceptions

from orchestrate.errors import InfrastructureError
from orchestrate.executors.base import Event, Executor, Prepare, Run, Task, TaskDone, WorkerLost
from orchestrate.executors.limits import NO_LIMITS, Limits
from orchestrate.executors.ray.connection import Cluster, Connection, OwnRay, first_line

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
        self._ray: Connection
        if address == "local":
            self._ray = OwnRay(workers)
        else:
            self._ray = Cluster(address, workers, prepare)
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
            return [WorkerLost(keys, _loss(error), node_lost=True)] if keys else []
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


def _loss(error: Exception) -> str:
    """Return the description of a lost node, with its address if Ray knows it."""
    address = re.search(r"Node IP: ([\w.:]+)", str(error))
    return f"lost with its machine {address[1]}" if address else "lost"
