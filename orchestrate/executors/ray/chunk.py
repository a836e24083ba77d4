"""Execution of a chunk on a Ray worker."""

from __future__ import annotations

from collections.abc import Iterator

from orchestrate.executors.base import Prepare, Run, Task, TaskDone
from orchestrate.executors.limits import Limits, ended_after, limit_memory
from orchestrate.executors.task import run_task
from orchestrate.executors.worker_environment import pin_threads

_STDERR = 2  # Ray writes it to a log file of the worker on its node


def run_chunk(
    run: Run,
    tasks: list[Task],
    limits: Limits,
    prepare: Prepare | None = None,
) -> Iterator[TaskDone | None]:
    """Run tasks in order; yield None when the first begins, then each outcome as it ends.

    ``prepare`` is called first, on machines where the launch has not called it.
    """
    pin_threads()
    if prepare:
        prepare()
    yield None
    for task in tasks:
        limit_memory(limits, task.memory_factor)
        with ended_after(limits, _STDERR):
            finished = run_task(run, task, limits)
        yield finished
