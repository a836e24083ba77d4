"""Registry of executors by the name in ``conf/executor/NAME.yaml``.

A new executor is a module with a ``FACTORY``, its configuration file, and an entry here. Neither
torch nor Ray is imported before an executor that needs it is made.
"""

from __future__ import annotations

from collections.abc import Mapping

from dopt.errors import unknown_name
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.executors import inprocess, local, lockstep, ray, slurm
from orchestrate.executors.base import Executor, Prepare, Run
from orchestrate.executors.factory import ExecutorFactory, Job

EXECUTORS: Mapping[str, ExecutorFactory] = {
    "inprocess": inprocess.FACTORY,
    "local": local.FACTORY,
    "lockstep": lockstep.FACTORY,
    "ray": ray.FACTORY,
    "slurm": slurm.FACTORY,
}


def executor_factory(settings: LaunchSettings) -> ExecutorFactory:
    """Return the entry of the executor that the settings name.

    Raises
    ------
    SpecificationError
        For an unknown name, with the nearest valid one.
    """
    if settings.executor not in EXECUTORS:
        raise unknown_name("executor.name", settings.executor, EXECUTORS)
    return EXECUTORS[settings.executor]


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
