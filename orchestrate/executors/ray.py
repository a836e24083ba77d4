"""Ray: the cores of this machine, or of a cluster by its address."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from typing import Any

import ray
from ray import exceptions

from orchestrate.errors import InfrastructureError
from orchestrate.executors.base import Event, Executor, Finished, Lost, Run, Task
from orchestrate.executors.task import run_task
from orchestrate.surroundings import ONE_THREAD, module_path, pin_threads

OBJECT_STORE_BYTES = 256 * 2**20
"""Room for the outcomes in flight; Ray would take a third of the memory."""

_WORKER_LOST = (exceptions.WorkerCrashedError, exceptions.OutOfMemoryError)
_NODE_LOST = (exceptions.NodeDiedError, exceptions.ObjectLostError)


class RayExecutor(Executor):
    """Runs each chunk as one Ray task, which Ray itself never repeats.

    Parameters
    ----------
    run
        What is done with a trial.
    workers
        Tasks at the same time; by default one on each core of the machine or cluster.
    address
        ``"local"`` starts a Ray that nobody else uses; anything else joins a cluster.
    """

    def __init__(self, run: Run, workers: int | None = None, address: str = "local") -> None:
        self._run = run
        self._workers = workers
        self._address = address
        self._chunks: dict[Any, Sequence[Task]] = {}
        self._remote: Any = None
        self._lost = False

    def start(self) -> None:
        try:
            ray.init(address=self._address, log_to_driver=False, **self._options())
        except Exception as error:
            raise InfrastructureError(
                f"Ray cannot be reached at '{self._address}' ({error}): check launch.ray.address, "
                "or use executor=local."
            ) from error
        self.slots = self._workers or int(_cpus())
        self._remote = ray.remote(num_cpus=1, max_retries=0)(_run_chunk)

    def _options(self) -> dict[str, Any]:
        surroundings = {**ONE_THREAD, **module_path()}
        if self._address != "local":
            return {"runtime_env": {"env_vars": surroundings}}
        # The workers of our own Ray inherit our environment, which is seconds faster.
        os.environ.update(surroundings)
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        return {
            "num_cpus": self._workers,
            "object_store_memory": OBJECT_STORE_BYTES,
            "include_dashboard": False,
            "logging_level": logging.ERROR,
        }

    def submit(self, chunk: Sequence[Task]) -> None:
        if chunk:
            self._chunks[self._remote.remote(self._run, list(chunk))] = chunk

    def wait(self, timeout: float) -> list[Event]:
        references = list(self._chunks)
        if not references:
            return []
        self._check_alive()
        ready, others = ray.wait(references, num_returns=1, timeout=timeout)
        if ready and others:
            ready += ray.wait(others, num_returns=len(others), timeout=0)[0]
        return [event for reference in ready for event in self._collect(reference)]

    @property
    def pending(self) -> int:
        return len(self._chunks)

    def stop(self) -> None:
        if not self._lost:
            for reference in self._chunks:
                ray.cancel(reference, force=True)
        self._chunks.clear()
        ray.shutdown()

    def _check_alive(self) -> None:
        """See that the processes of our own Ray run; by itself it takes a minute to notice."""
        node: Any = ray._private.worker._global_node
        if self._address != "local" or node is None:
            return
        dead = {kind for kind, _ in node.dead_processes()} & {"gcs_server", "raylet"}
        if dead:
            self._lost = True
            raise InfrastructureError(
                f"Ray's {' and '.join(sorted(dead))} has ended: run the same command again "
                "to go on."
            )

    def _collect(self, reference: Any) -> list[Event]:
        chunk = self._chunks.pop(reference)
        keys = tuple(task.key for task in chunk)
        try:
            finished: list[Finished] = ray.get(reference)
        except _WORKER_LOST as error:
            return [Lost(keys, _first_line(error))]
        except _NODE_LOST as error:
            return [Lost(keys, _first_line(error), blameless=True)]
        except exceptions.RayError as error:
            raise InfrastructureError(
                f"Ray has failed ({_first_line(error)}): run the same command again to go on."
            ) from error
        return list(finished)


def _cpus() -> float:
    resources: dict[str, float] = ray.cluster_resources()  # type: ignore[no-untyped-call]
    return resources.get("CPU", 1.0)


def _run_chunk(run: Run, tasks: list[Task]) -> list[Finished]:
    pin_threads()
    return [run_task(run, task) for task in tasks]


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
