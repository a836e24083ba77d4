"""Factory of the Ray executor; Ray itself is imported when the executor is made."""

from __future__ import annotations

from dopt.cores import usable_cores
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.executors.base import Executor, Prepare, Run
from orchestrate.executors.factory import ExecutorFactory, limits_of


def _make(settings: LaunchSettings, run: Run, prepare: Prepare | None) -> Executor:
    from orchestrate.executors.ray.executor import RayExecutor  # importing Ray takes a second

    limits = limits_of(settings)
    return RayExecutor(run, settings.workers, settings.ray_address, limits, prepare)


def _trials_at_once(settings: LaunchSettings) -> int | None:
    """Return the number of workers on this machine; None for a cluster."""
    if settings.ray_address != "local":
        return None
    return settings.workers or usable_cores()


FACTORY = ExecutorFactory(_make, _trials_at_once)
