"""The trials of one configuration together, in torch: on a graphics processor or on this one.

The reference (:mod:`dopt.reference`) takes each step for the whole batch at once. The numbers are
those of the trials run one by one, to rounding.
"""

from __future__ import annotations

import dataclasses
import os
import resource
import socket
import time
from collections import deque
from collections.abc import Sequence
from datetime import UTC, datetime

from dopt.result import TrialResult
from orchestrate.errors import LaunchError
from orchestrate.executors.base import Event, Executor, Finished, Task, Trouble, Usage
from orchestrate.executors.task import KIBIBYTE, trouble


class LockstepExecutor(Executor):
    """Runs a chunk, which holds trials of one configuration, as one batch in this process.

    A batch has no limit of time: its trials take their steps together, and none of them could be
    stopped without the others.

    Parameters
    ----------
    device : str
        Torch device, such as ``"cpu"`` or ``"cuda"``.
    batch : int
        Trials in a batch at most.
    """

    def __init__(self, device: str, batch: int) -> None:
        self._device = device
        self.batch = batch
        self._chunks: deque[list[Task]] = deque()

    def start(self) -> None:
        check_device(self._device)
        self.slots = 1

    def submit(self, chunk: Sequence[Task]) -> None:
        if chunk:
            self._chunks.append(list(chunk))

    def wait(self, timeout: float) -> list[Event]:  # noqa: ARG002  # a batch cannot be left
        return list(run_batch(self._chunks.popleft(), self._device)) if self._chunks else []

    @property
    def pending(self) -> int:
        return len(self._chunks)

    def stop(self) -> None:
        self._chunks.clear()


def check_device(device: str) -> None:
    """Raise LaunchError if torch cannot run on a device here."""
    import torch

    kind, _, number = device.partition(":")
    there = torch.cuda.device_count() if kind == "cuda" else 0
    if device != "cpu" and not (kind == "cuda" and (number or "0") in map(str, range(there))):
        raise LaunchError(
            f"executor.device is '{device}', but torch can run here on cpu and on "
            f"{there} CUDA devices: set executor.device=cpu."
        )


def run_batch(tasks: Sequence[Task], device: str) -> list[Finished]:
    """Run tasks of one configuration in lockstep; an exception is every task's."""
    from dopt.assessment import assessed
    from dopt.reference.lockstep import run_trials

    started, wall, cpu = datetime.now(UTC), time.perf_counter(), time.process_time()
    outcomes: Sequence[TrialResult | Trouble]
    try:
        specs = [task.spec for task in tasks]
        results = run_trials(specs, device)
        outcomes = [assessed(spec, result) for spec, result in zip(specs, results, strict=True)]
    except Exception as error:
        outcomes = [trouble(error)] * len(tasks)
    share = Usage(
        node=socket.gethostname(),
        pid=os.getpid(),
        wall_seconds=(time.perf_counter() - wall) / len(tasks),
        cpu_seconds=(time.process_time() - cpu) / len(tasks),
        peak_memory_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * KIBIBYTE,
        started=started,
        ended=datetime.now(UTC),
    )
    return [
        Finished(task.key, dataclasses.replace(share), outcome)
        for task, outcome in zip(tasks, outcomes, strict=True)
    ]
