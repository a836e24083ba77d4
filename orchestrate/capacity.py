"""Whether the grid fits into the memory of this machine, asked before anything runs."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

from dopt.cell import Cell
from orchestrate.errors import LaunchError
from orchestrate.grid import Grid
from orchestrate.settings import LaunchSettings

GIBIBYTE = 2**30
CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


def check_memory(grid: Grid, settings: LaunchSettings, machine: int | None = None) -> None:
    """Refuse trials that would only be ended by the machine when it has no memory left.

    Parameters
    ----------
    grid, settings
        What is to run, and how. Of a cluster that is started elsewhere, and of a graphics
        processor, nothing is known here.
    machine
        Bytes of memory; None asks this machine.

    Raises
    ------
    LaunchError
        If one trial does not fit, or all that run at the same time.
    """
    if not grid.trials:
        return
    counts = Counter(trial.config_key for trial in grid.trials)
    cells = {trial.config_key: trial.cell for trial in grid.trials}
    keys = sorted(cells, key=lambda key: cells[key].memory, reverse=True)
    largest = cells[keys[0]]
    _check_worker(largest, settings)
    if settings.device != "cpu" or (settings.executor == "ray" and settings.ray_address != "local"):
        return
    most = memory_of_this_machine() if machine is None else machine
    if largest.memory > most:
        raise LaunchError(
            f"{_name(largest)} needs {_gib(largest.memory)} of memory, but this machine has "
            f"{_gib(most)}: make {largest.largest_setting} smaller."
        )
    needs = [cells[key].memory for key in keys for _ in range(min(counts[key], _at_once(settings)))]
    together = needs[: _at_once(settings)]
    if sum(together) > most:
        key = "executor.batch" if settings.executor == "lockstep" else "launch.workers"
        raise LaunchError(
            f"{len(together)} trials at the same time need {_gib(sum(together))} of memory, but "
            f"this machine has {_gib(most)}: set {key}={most // largest.memory}."
        )


def memory_of_this_machine() -> int:
    """Return the bytes of memory that this process may use."""
    physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        return min(physical, int(CGROUP_LIMIT.read_text()))
    except (OSError, ValueError):  # not in a group, or in one without a limit
        return physical


def _check_worker(cell: Cell, settings: LaunchSettings) -> None:
    if settings.memory_gib is not None and cell.memory > settings.memory_gib * GIBIBYTE:
        raise LaunchError(
            f"{_name(cell)} needs {_gib(cell.memory)} of memory, but launch.memory_gib allows "
            f"{settings.memory_gib:g} GiB: raise it, or make {cell.largest_setting} smaller."
        )


def _at_once(settings: LaunchSettings) -> int:
    if settings.executor == "lockstep":
        return settings.batch
    if settings.executor == "inprocess":
        return 1
    if settings.executor == "local":
        return settings.workers or len(os.sched_getaffinity(0))
    return settings.workers or os.cpu_count() or 1  # Ray does not ask which of them we may use


def _name(cell: Cell) -> str:
    return f"a trial of env={cell.system.name} policy={cell.policy.name}"


def _gib(count: int) -> str:
    return f"{count / GIBIBYTE:,.3g} GiB" if count < 1000 * GIBIBYTE else f"{count >> 30:,} GiB"
