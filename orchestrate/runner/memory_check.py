"""Memory check of a grid against this machine, before anything runs."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

from dopt.spec.config import TrialConfig
from orchestrate.config.grid import Grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.errors import LaunchError
from orchestrate.executors.registry import executor_factory

BYTES_PER_GIB = 2**30
CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


def check_memory(grid: Grid, settings: LaunchSettings, machine: int | None = None) -> None:
    """Refuse a grid whose trials need more memory than there is.

    Parameters
    ----------
    grid, settings
        Trials and settings of the launch. The memory of a cluster and of a GPU is not checked.
    machine
        Bytes of memory; None reads them from this machine.

    Raises
    ------
    LaunchError
        If one trial does not fit, or the trials that run at the same time do not.
    """
    if not grid.trials:
        return
    counts = Counter(trial.config_key for trial in grid.trials)
    configs = {trial.config_key: trial.config for trial in grid.trials}
    keys = sorted(configs, key=lambda key: configs[key].memory, reverse=True)
    largest = configs[keys[0]]
    _check_worker(largest, settings)
    factory = executor_factory(settings)
    at_once = factory.trials_at_once(settings)
    if at_once is None:
        return
    available = memory_of_this_machine() if machine is None else machine
    if largest.memory > available:
        raise LaunchError(
            f"{_name(largest)} needs {_gib(largest.memory)} of memory, but this machine has "
            f"{_gib(available)}: make {largest.largest_setting} smaller."
        )
    needs = [configs[key].memory for key in keys for _ in range(min(counts[key], at_once))]
    together = needs[:at_once]
    if sum(together) > available:
        raise LaunchError(
            f"{len(together)} trials at the same time need {_gib(sum(together))} of memory, but "
            f"this machine has {_gib(available)}: set {factory.limiting_key}="
            f"{available // largest.memory}."
        )


def memory_of_this_machine() -> int:
    """Return the bytes of memory that this process may use."""
    physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        return min(physical, int(CGROUP_LIMIT.read_text()))
    except (OSError, ValueError):  # not in a group, or in one without a limit
        return physical


def _check_worker(config: TrialConfig, settings: LaunchSettings) -> None:
    if settings.memory_gib is not None and config.memory > settings.memory_gib * BYTES_PER_GIB:
        raise LaunchError(
            f"{_name(config)} needs {_gib(config.memory)} of memory, but launch.memory_gib allows "
            f"{settings.memory_gib:g} GiB: raise it, or make {config.largest_setting} smaller."
        )


def _name(config: TrialConfig) -> str:
    return f"a trial of env={config.system.name} policy={config.policy.name}"


def _gib(count: int) -> str:
    return (
        f"{count / BYTES_PER_GIB:,.3g} GiB"
        if count < 1000 * BYTES_PER_GIB
        else f"{count >> 30:,} GiB"
    )
