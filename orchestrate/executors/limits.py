"""What a trial may take of wall time and memory, and how it is stopped when it takes more.

Time has two limits. At the first one a signal raises an exception in the trial, whose traceback
says where it hung. Native code that never comes back to the interpreter sees no signal: at the
second limit a thread of C code, which needs no lock of the interpreter, ends the whole process.
"""

from __future__ import annotations

import ctypes
import faulthandler
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

GRACE_SECONDS = 10.0
"""At most so long after the first limit comes the second."""

GIBIBYTE = 2**30

_PR_SET_PDEATHSIG = 1


class TrialTimeoutError(BaseException):
    """A trial took too long; no ``except Exception`` in the trial can take it for its own."""


@dataclass(frozen=True)
class Limits:
    """Seconds of wall time for one trial and GiB for a worker process; None for no limit."""

    seconds: float | None = None
    memory_gib: float | None = None

    @property
    def last_seconds(self) -> float | None:
        """Seconds after which a trial that did not heed the first limit ends with its process."""
        return None if self.seconds is None else self.seconds + min(GRACE_SECONDS, 1 + self.seconds)

    @property
    def sentence(self) -> str:
        """What is said of a trial that took too long."""
        return f"timeout after {self.seconds:g} s"


NO_LIMITS = Limits()


@contextmanager
def interrupted_after(limits: Limits) -> Iterator[None]:
    """Raise ``TrialTimeoutError`` in the block, which runs in the main thread, at the limit.

    A timer that somebody else has set goes on afterwards.
    """
    if limits.seconds is None:
        yield
        return

    def ring(_: int, __: FrameType | None) -> None:
        raise TrialTimeoutError(limits.sentence)

    handler = signal.signal(signal.SIGALRM, ring)
    timer = signal.setitimer(signal.ITIMER_REAL, limits.seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)  # a signal that has just come raises here
        signal.setitimer(signal.ITIMER_REAL, *timer)


@contextmanager
def ended_after(limits: Limits, last_words: int) -> Iterator[None]:
    """End this process if the block takes longer than the last limit.

    Where every thread was goes to the file descriptor ``last_words``.
    """
    if limits.last_seconds is None:
        yield
        return
    faulthandler.dump_traceback_later(limits.last_seconds, exit=True, file=last_words)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def limit_memory(limits: Limits) -> None:
    """Let this process get no more memory than the limit; beyond it ``MemoryError`` is raised."""
    if limits.memory_gib is not None:
        most = int(limits.memory_gib * GIBIBYTE)
        resource.setrlimit(
            resource.RLIMIT_DATA, (most, resource.getrlimit(resource.RLIMIT_DATA)[1])
        )


def die_with_parent() -> None:
    """Let the kernel kill this process when its parent ends.

    A trial that holds the interpreter's lock lets no thread notice that the parent has gone.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
