"""Registry of executors by the name in ``conf/executor/NAME.yaml``, and the factory of each.

A new executor is a module with a ``FACTORY``, its configuration file, and an entry here. The module
of an executor is imported when a launch names it, torch or Ray when the executor is made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Protocol

from dopt.errors import unknown_name
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.executors.base import Executor, Prepare, Run
from orchestrate.executors.limits import Limits

EXECUTORS: Mapping[str, str] = {
    name: f"orchestrate.executors.{name}"
    for name in ("inprocess", "local", "lockstep", "ray", "slurm")
}
"""Module of each executor."""


def _accept(_: LaunchSettings) -> None:
    """Accept all settings."""


class Job(Protocol):
    """Job of a batch system, in which workers take the trials from the database."""

    def text(self, trials: int) -> str:
        """Return the script that is submitted for a grid with so many trials to run."""
        ...

    def submit(self, trials: int, environment: Mapping[str, str]) -> str:
        """Submit the job, whose workers get the variables, and return a sentence about it.

        Raises
        ------
        LaunchError, InfrastructureError
            If the batch system refuses the job, or cannot be reached.
        """
        ...


@dataclass(frozen=True)
class ExecutorFactory:
    """Constructor of an executor, and the facts that a launch needs before it starts one.

    Attributes
    ----------
    make
        Returns the executor for the settings, not yet started. The last argument has been called
        on this machine; machines of a cluster call it before their first trial. None where a job
        runs the trials.
    trials_at_once
        Number of trials that hold memory of this machine at the same time; None where they use
        other memory.
    check
        Raises ``LaunchError`` for settings that cannot work here, before any trial is registered.
    path
        Execution path of the trials, "kernel" or "reference".
    in_process
        Whether trials run in the process of the launch; a single trial then uses this executor.
    limiting_key
        Key that reduces ``trials_at_once``.
    job
        Returns the job that runs the grid after the launch has left, or raises ``LaunchError``.
    """

    make: Callable[[LaunchSettings, Run, Prepare | None], Executor] | None
    trials_at_once: Callable[[LaunchSettings], int | None]
    check: Callable[[LaunchSettings], None] = _accept
    path: str = "kernel"
    in_process: bool = False
    limiting_key: str = "launch.workers"
    job: Callable[[LaunchSettings], Job] | None = None


def limits_of(settings: LaunchSettings) -> Limits:
    """Return the limits of one trial."""
    return Limits(settings.timeout, settings.memory_gib)


def executor_factory(settings: LaunchSettings) -> ExecutorFactory:
    """Return the factory of the executor that the settings name.

    Raises
    ------
    SpecificationError
        For an unknown name, with the nearest valid one.
    """
    if settings.executor not in EXECUTORS:
        raise unknown_name("executor.name", settings.executor, EXECUTORS)
    factory: ExecutorFactory = import_module(EXECUTORS[settings.executor]).FACTORY
    return factory


def make_executor(settings: LaunchSettings, run: Run, prepare: Prepare | None = None) -> Executor:
    """Return the executor that the settings name, not yet started."""
    make = executor_factory(settings).make
    assert make is not None, f"a job runs the trials of executor={settings.executor}"
    return make(settings, run, prepare)


def make_job(settings: LaunchSettings) -> Job | None:
    """Return the job that a launch submits before it leaves, or None where it submits none.

    Raises
    ------
    LaunchError
        For wrong settings of the job.
    """
    make = executor_factory(settings).job
    return None if make is None or settings.detach else make(settings)
