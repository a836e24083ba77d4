"""A planner that is waited for until a deadline."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as TooLate

from dopt.spec.trial import TrialSpec


class PunctualPlanner:
    """Makes plans in this thread, or with a deadline in a thread of its own.

    Compiled plans run beside the interpreter, so that the deadline holds while they do.

    Parameters
    ----------
    make : callable
        Makes a plan.
    deadline : float or None
        Seconds that one is waited for.
    """

    def __init__(self, make: Callable[[], None], deadline: float | None) -> None:
        self._make, self._deadline = make, deadline
        self._late: Future[None] | None = None
        self._thread = None if deadline is None else ThreadPoolExecutor(1, "planner")
        if self._thread is not None:
            self._thread.submit(int).result()  # the thread is there before the first deadline

    def plan(self) -> bool:
        """Make a plan, and return whether it was ready in time; otherwise call :meth:`wait`."""
        if self._thread is None:
            self._make()
            return True
        plan = self._thread.submit(self._make)
        try:
            plan.result(timeout=self._deadline)
        except TooLate:
            self._late = plan
            return False
        return True

    @property
    def is_late(self) -> bool:
        """Whether a plan is still being made."""
        return self._late is not None and not self._late.done()

    def wait(self) -> bool:
        """Wait for a plan that was not ready in time, and return whether there was one."""
        if self._late is None:
            return False
        plan, self._late = self._late, None
        plan.result()
        return True

    def close(self) -> None:
        """End the thread."""
        if self._thread is not None:
            self._thread.shutdown()


def may_remember_plans(spec: TrialSpec) -> bool:
    """Tell whether the plan of a step may depend on those of the steps before."""
    policy, q = spec.policy, spec.model.n_parameters(spec.system)
    compiled = policy.compiled and not policy.is_in_numpy()
    return not compiled or policy.memory_size(spec.system, q) > 0
