"""Executor on Ray, one machine or a cluster; Ray itself is imported when the executor is made."""

from __future__ import annotations

import os
import sys

from dopt.process import usable_cores
from orchestrate.config import LaunchSettings
from orchestrate.executors.base import (
    Executor,
    ExecutorFactory,
    Prepare,
    Run,
    check_processes,
    limits_of,
)

if "ray" not in sys.modules:
    # Ray reads this when it is first imported. A driver without it takes its raylet for dead if the
    # parent of the driver is process 1, as after setsid or in a container, and is ended with no
    # exception when a call to a dead raylet fails. The raylet gives its own number to workers.
    os.environ["RAY_RAYLET_PID"] = str(os.getpid())


def _make(settings: LaunchSettings, run: Run, prepare: Prepare | None) -> Executor:
    from orchestrate.executors.ray.executor import RayExecutor  # importing Ray takes a second

    limits = limits_of(settings)
    return RayExecutor(run, settings.workers, settings.ray_address, limits, prepare)


def _trials_at_once(settings: LaunchSettings) -> int | None:
    """Return the number of workers on this machine; None for a cluster."""
    if settings.ray_address != "local":
        return None
    return settings.workers or usable_cores()


def _check(settings: LaunchSettings) -> None:
    if settings.ray_address == "local":
        check_processes(settings)


FACTORY = ExecutorFactory(_make, _trials_at_once, _check, options=())
