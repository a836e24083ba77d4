"""Limits of a trial and environment of its worker process.

There are two time limits. At the first one a signal raises an exception in the trial, whose
traceback shows where it hung. Native code that does not return to the interpreter sees no signal:
at the second limit a C thread, which needs no interpreter lock, ends the process.

With one thread for each process the workers share the cores, and sums keep their order.
"""

from __future__ import annotations

import ctypes
import faulthandler
import os
import resource
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.machinery import PathFinder
from pathlib import Path
from types import FrameType

GRACE_SECONDS = 10.0
"""Largest time between the first limit and the second."""

BYTES_PER_GIB = 2**30

_PR_SET_PDEATHSIG = 1


class TrialTimeoutError(BaseException):
    """Raised at the time limit; no ``Exception``, so that a trial does not catch it by accident."""


@dataclass(frozen=True)
class Limits:
    """Wall time of one trial [s] and memory of a worker process [GiB]; None for no limit."""

    seconds: float | None = None
    memory_gib: float | None = None

    @property
    def last_seconds(self) -> float | None:
        """Seconds after which the process of a trial is killed if the first limit had no effect."""
        return None if self.seconds is None else self.seconds + min(GRACE_SECONDS, 1 + self.seconds)

    @property
    def timeout_message(self) -> str:
        """Error message of a trial that took too long."""
        return f"timeout after {self.seconds:g} s"


NO_LIMITS = Limits()


@contextmanager
def interrupted_after(limits: Limits) -> Iterator[None]:
    """Raise ``TrialTimeoutError`` in the block, which runs in the main thread, at the limit.

    A timer that was set before is restored afterwards.
    """
    if limits.seconds is None:
        yield
        return

    def raise_timeout(_: int, __: FrameType | None) -> None:
        raise TrialTimeoutError(limits.timeout_message)

    handler = signal.signal(signal.SIGALRM, raise_timeout)
    timer = signal.setitimer(signal.ITIMER_REAL, limits.seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)  # a signal that has just arrived raises here
        signal.setitimer(signal.ITIMER_REAL, *timer)


@contextmanager
def ended_after(limits: Limits, descriptor: int) -> Iterator[None]:
    """End this process if the block takes longer than the last limit.

    The stacks of all threads are written to the file ``descriptor``.
    """
    if limits.last_seconds is None:
        yield
        return
    faulthandler.dump_traceback_later(limits.last_seconds, exit=True, file=descriptor)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def limit_memory(limits: Limits, factor: float = 1.0) -> None:
    """Set the memory limit of this process, beyond which ``MemoryError`` is raised."""
    if limits.memory_gib is not None:
        most_bytes = int(factor * limits.memory_gib * BYTES_PER_GIB)
        resource.setrlimit(
            resource.RLIMIT_DATA, (most_bytes, resource.getrlimit(resource.RLIMIT_DATA)[1])
        )


def die_with_parent() -> None:
    """Make the kernel kill this process when its parent ends.

    A thread cannot do this while a trial holds the interpreter lock.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "BLIS_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "NUMBA_NUM_THREADS",
    ),
    "1",
)

_PACKAGE = __name__.partition(".")[0]


def pin_threads() -> None:
    """Pin the numerical libraries of this process, and of those it starts, to one thread.

    The variables act on libraries that are imported later; a loaded torch is set directly.
    """
    os.environ.update(ONE_THREAD)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


def module_path() -> dict[str, str]:
    """Return the environment in which another interpreter finds the modules that this one finds.

    A folder with another ``orchestrate``, such as a user's script of that name, comes last.
    """
    root = str(Path(__file__).resolve().parents[2])
    paths = [path for path in sys.path if path]
    first = [] if root in paths else [root]  # an installed copy stays after the standard library
    paths.sort(key=lambda path: path != root and PathFinder.find_spec(_PACKAGE, [path]) is not None)
    return {"PYTHONPATH": os.pathsep.join([*first, *paths])}
