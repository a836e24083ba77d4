"""Factory of an executor: its constructor, and the facts a launch needs before it is started."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.executors.base import Executor, Prepare, Run
from orchestrate.executors.limits import Limits


def _accept(_: LaunchSettings) -> None:
    """Accept all settings."""


class Job(Protocol):
    """Job of a batch system, in which workers take the trials from the database."""

    def text(self, trials: int) -> str:
        """Return what is submitted for a grid with so many trials to run."""
        ...

    def submit(self, trials: int, environment: Mapping[str, str]) -> str:
        """Submit the job, whose workers get the variables, and return what to say of it.

        Raises
        ------
        LaunchError, InfrastructureError
            If the batch system refuses the job, or cannot be reached.
        """
        ...


@dataclass(frozen=True)
class ExecutorFactory:
    """Entry of the executor registry.

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
