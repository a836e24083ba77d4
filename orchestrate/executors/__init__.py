"""Where trials run: in this process, in a pool of processes, on Ray, or in lockstep."""

from __future__ import annotations

from collections.abc import Callable

from orchestrate.executors.base import Executor, Run
from orchestrate.executors.inprocess import InProcessExecutor
from orchestrate.executors.limits import Limits
from orchestrate.executors.local import LocalExecutor
from orchestrate.executors.lockstep import LockstepExecutor, check_device
from orchestrate.settings import LaunchSettings


def check_executor(settings: LaunchSettings) -> None:
    """Raise LaunchError for what can be seen to be missing before any trial is registered."""
    if settings.executor == "lockstep":
        check_device(settings.device)


def make_executor(
    settings: LaunchSettings, run: Run, prepare: Callable[[], None] | None = None
) -> Executor:
    """Return the executor that the settings name, not yet started.

    ``prepare`` has been called here, and is for machines elsewhere to call too.
    """
    limits = Limits(settings.timeout, settings.memory_gib)
    if settings.executor == "inprocess":
        return InProcessExecutor(run, limits)
    if settings.executor == "local":
        return LocalExecutor(run, settings.workers, limits)
    if settings.executor == "lockstep":
        return LockstepExecutor(settings.device, settings.batch)
    from orchestrate.executors.ray import RayExecutor  # importing Ray takes a second

    return RayExecutor(run, settings.workers, settings.ray_address, limits, prepare)
