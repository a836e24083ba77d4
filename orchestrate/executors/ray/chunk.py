"""What a worker of Ray does with a chunk."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from orchestrate.executors.base import Finished, Run, Task
from orchestrate.executors.limits import Limits, ended_after, limit_memory
from orchestrate.executors.task import run_task
from orchestrate.surroundings import pin_threads

Prepare = Callable[[], None]

_STDERR = 2  # Ray keeps it in a file of the worker, on the node


def run_chunk(
    run: Run, tasks: list[Task], limits: Limits, prepare: Prepare | None = None
) -> Iterator[Finished | None]:
    """Run tasks in order; yield None when the first begins, then each outcome as it ends.

    ``prepare`` is called before, where the launch could not do it for this machine.
    """
    pin_threads()
    limit_memory(limits)
    if prepare:
        prepare()
    yield None
    for task in tasks:
        with ended_after(limits, _STDERR):
            finished = run_task(run, task, limits)
        yield finished
