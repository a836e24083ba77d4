"""Executor that runs trials one after the other in this process, so that breakpoints work."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from orchestrate.executors.base import Event, Executor, Run, Task, run_task
from orchestrate.executors.limits import NO_LIMITS, Limits
from orchestrate.executors.registry import ExecutorFactory, limits_of


class QueueExecutor(Executor):
    """Queue of chunks that run in this process, in calls of ``wait``."""

    def __init__(self) -> None:
        self._chunks: deque[deque[Task]] = deque()

    def start(self) -> None:
        self.slots = 1

    def submit(self, chunk: Sequence[Task]) -> None:
        if chunk:
            self._chunks.append(deque(chunk))

    @property
    def pending(self) -> int:
        return len(self._chunks)

    def stop(self) -> None:
        self._chunks.clear()


class InProcessExecutor(QueueExecutor):
    """Runs one task at each call of ``wait``.

    A time limit cannot stop native code that does not return to the interpreter. The memory limit
    is not set, because it would hold for the whole launch.
    """

    def __init__(self, run: Run, limits: Limits = NO_LIMITS) -> None:
        super().__init__()
        self._run = run
        self._limits = limits

    def wait(self, timeout: float) -> list[Event]:  # noqa: ARG002  # a running trial is not left
        if not self._chunks:
            return []
        event = run_task(self._run, self._chunks[0].popleft(), self._limits)
        if not self._chunks[0]:
            self._chunks.popleft()
        return [event]


FACTORY = ExecutorFactory(
    make=lambda settings, run, _: InProcessExecutor(run, limits_of(settings)),
    trials_at_once=lambda _: 1,
    in_process=True,
)
