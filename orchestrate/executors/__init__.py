"""Where trials run: in this process, in a pool of processes, on Ray, or in lockstep."""

from __future__ import annotations

from orchestrate.executors.base import Executor, Run
from orchestrate.executors.inprocess import InProcessExecutor
from orchestrate.executors.local import LocalExecutor
from orchestrate.executors.lockstep import LockstepExecutor
from orchestrate.settings import LaunchSettings


def make_executor(settings: LaunchSettings, run: Run) -> Executor:
    """Return the executor that the settings name, not yet started."""
    if settings.executor == "inprocess":
        return InProcessExecutor(run)
    if settings.executor == "local":
        return LocalExecutor(run, settings.workers)
    if settings.executor == "lockstep":
        return LockstepExecutor(settings.device, settings.batch)
    from orchestrate.executors.ray import RayExecutor  # importing Ray takes a second

    return RayExecutor(run, settings.workers, settings.ray_address)
