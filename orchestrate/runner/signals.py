"""Signal handlers: the first Ctrl-C lets running trials finish, the second stops at once."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType, TracebackType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM)
FINISHING = "\nCtrl-C: finishing running trials; press again to stop immediately\n"

MAX_HELD_SIGNALS = 3
"""Signals during one undisturbed block after which it is interrupted."""


REPETITION_SECONDS = 1.0
"""Time after a signal in which others repeat it.

A batch system may signal all processes of a job, whose shell passes the signal on.
"""


class Repetition:
    """Recognition of signals that repeat an earlier one; Ctrl-C is pressed once more on purpose."""

    def __init__(self) -> None:
        self._end = 0.0

    def __call__(self, number: int) -> bool:
        """Return whether the signal, which has just come, repeats another."""
        now = time.monotonic()
        if number != signal.SIGINT and now < self._end:
            return True
        self._end = now + REPETITION_SECONDS
        return False


class Interrupt:
    """Context manager in which the first signal sets ``stop_requested``, and calls ``at_first``.

    Raises
    ------
    KeyboardInterrupt
        At the second signal.
    """

    def __init__(
        self,
        signals: Sequence[signal.Signals] = SIGNALS,
        notice: str = FINISHING,
        at_first: Callable[[], None] = lambda: None,
    ) -> None:
        self.stop_requested = False
        self._at_first = at_first
        self._signals = signals
        self._notice = notice
        self._before: dict[signal.Signals, Any] = {}
        self._repeated = Repetition()

    def __enter__(self) -> Self:
        self._before = {number: signal.signal(number, self._handle) for number in self._signals}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _: object, __: TracebackType | None
    ) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)

    def _handle(self, number: int, _: FrameType | None) -> None:
        if self._repeated(number):
            return
        if self.stop_requested:
            raise KeyboardInterrupt
        self.stop_requested = True
        self._at_first()
        with suppress(RuntimeError):  # the signal arrived while this stream was being written
            sys.stderr.write(self._notice)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Delay signals until the end of the block.

    An interrupt in the middle of a transaction could leave the connection, and its locks, open.

    Raises
    ------
    KeyboardInterrupt
        In the block, at the third signal.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []

    def hold(number: int, _: FrameType | None) -> None:
        held.append(number)
        if len(held) == MAX_HELD_SIGNALS:
            raise KeyboardInterrupt

    # SIGUSR1 belongs to whoever uses it, but for a handler that is set as ours are.
    used = [signal.SIGUSR1] if callable(signal.getsignal(signal.SIGUSR1)) else []
    before = {number: signal.signal(number, hold) for number in (*SIGNALS, *used)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for one in held:
            signal.raise_signal(one)
