"""Registry of executors by the name in ``conf/executor/NAME.yaml``.

A new executor is a module with a ``FACTORY``, its configuration file, and an entry here. Neither
torch nor Ray is imported before an executor that needs it is made.
"""

from __future__ import annotations

from collections.abc import Mapping

from dopt.errors import unknown_name
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.executors import inprocess, local, lockstep
from orchestrate.executors.base import Executor, Prepare, Run
from orchestrate.executors.factory import ExecutorFactory
from orchestrate.executors.ray import factory as ray

EXECUTORS: Mapping[str, ExecutorFactory] = {
    "inprocess": inprocess.FACTORY,
    "local": local.FACTORY,
    "lockstep": lockstep.FACTORY,
    "ray": ray.FACTORY,
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
    return executor_factory(settings).make(settings, run, prepare)
