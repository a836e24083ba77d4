"""Executor that runs the trials of one configuration as torch batches, on a GPU or the CPU.

The torch path (:mod:`dopt.reference`) takes each step for the whole batch at once: of the paper's
policies, open-loop ones and custom networks. Other trials are refused with a sentence. The numbers
equal the results of the kernel up to rounding.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from datetime import UTC, datetime

from dopt.result import TrialResult
from orchestrate.config import LaunchSettings, count, text
from orchestrate.errors import LaunchError
from orchestrate.executors.base import (
    Event,
    ExecutorFactory,
    QueueExecutor,
    Task,
    TaskDone,
    failure_of,
    record_of,
)
from orchestrate.records import Failure

DEVICE = "cpu"
BATCH_SIZE = 100


class LockstepExecutor(QueueExecutor):
    """Runs each chunk of trials of one configuration as one batch in this process.

    A batch has no time limit: its trials advance together, so that none can be stopped alone.

    Parameters
    ----------
    device : str
        Torch device, such as ``"cpu"`` or ``"cuda"``.
    batch : int
        Largest number of trials in a batch.
    """

    def __init__(self, device: str, batch: int) -> None:
        super().__init__()
        self._device = device
        self.batch = batch

    def start(self) -> None:
        check_device(self._device)
        super().start()

    def wait(self, timeout: float) -> list[Event]:  # noqa: ARG002  # a running batch is not left
        return run_batch(self._chunks.popleft(), self._device) if self._chunks else []


def check_device(device: str) -> None:
    """Raise ``LaunchError`` unless torch can use the device on this machine."""
    import torch

    kind, _, number = device.partition(":")
    n_devices = torch.cuda.device_count() if kind == "cuda" else 0
    if device != "cpu" and not (kind == "cuda" and (number or "0") in map(str, range(n_devices))):
        raise LaunchError(
            f"executor.device is '{device}', but torch can run here on cpu and on "
            f"{n_devices} CUDA devices: set executor.device=cpu."
        )


def run_batch(tasks: Sequence[Task], device: str) -> list[Event]:
    """Run tasks of one configuration as a batch; an exception fails all of them."""
    from dopt.assessment import assessed
    from dopt.reference.batch import run_trials

    started, wall, cpu = datetime.now(UTC), time.perf_counter(), time.process_time()
    outcomes: Sequence[TrialResult | Failure]
    try:
        specs = [task.spec for task in tasks]
        results = run_trials(specs, device)
        outcomes = [assessed(spec, result) for spec, result in zip(specs, results, strict=True)]
    except Exception as error:
        outcomes = [failure_of(error)] * len(tasks)
    wall_seconds, cpu_seconds = time.perf_counter() - wall, time.process_time() - cpu
    share = record_of(started, wall_seconds / len(tasks), cpu_seconds / len(tasks))
    return [
        TaskDone(task.key, share, outcome) for task, outcome in zip(tasks, outcomes, strict=True)
    ]


def _device(settings: LaunchSettings) -> str:
    return str(text("executor.device", settings.executor_options.get("device", DEVICE)))


def _batch_size(settings: LaunchSettings) -> int:
    given = settings.executor_options.get("batch")
    return count("executor.batch", given) or BATCH_SIZE


def _check(settings: LaunchSettings) -> None:
    _batch_size(settings)
    check_device(_device(settings))


def _trials_at_once(settings: LaunchSettings) -> int | None:
    """Return the batch size; None on a GPU, whose memory is not known here."""
    return _batch_size(settings) if _device(settings) == "cpu" else None


FACTORY = ExecutorFactory(
    make=lambda settings, *_: LockstepExecutor(_device(settings), _batch_size(settings)),
    trials_at_once=_trials_at_once,
    check=_check,
    path="reference",
    in_process=True,
    options=("device", "batch"),
    limiting_key="executor.batch",
)
