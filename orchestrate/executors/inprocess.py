"""One trial after the other in this process: breakpoints work."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from orchestrate.executors.base import Event, Executor, Run, Task
from orchestrate.executors.limits import NO_LIMITS, Limits
from orchestrate.executors.task import run_task


class InProcessExecutor(Executor):
    """Runs a task each time it is asked for an outcome.

    A limit of time cannot stop native code that does not come back to the interpreter, and one of
    memory would be a limit of the whole launch: it is not set.
    """

    def __init__(self, run: Run, limits: Limits = NO_LIMITS) -> None:
        self._run = run
        self._limits = limits
        self._chunks: deque[deque[Task]] = deque()

    def start(self) -> None:
        self.slots = 1

    def submit(self, chunk: Sequence[Task]) -> None:
        if chunk:
            self._chunks.append(deque(chunk))

    def wait(self, timeout: float) -> list[Event]:  # noqa: ARG002  # a trial cannot be left
        if not self._chunks:
            return []
        event = run_task(self._run, self._chunks[0].popleft(), self._limits)
        if not self._chunks[0]:
            self._chunks.popleft()
        return [event]

    @property
    def pending(self) -> int:
        return len(self._chunks)

    def stop(self) -> None:
        self._chunks.clear()
