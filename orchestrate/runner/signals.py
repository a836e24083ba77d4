"""Ctrl-C: once lets what runs end, twice stops at once."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType, TracebackType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM)

IMPATIENT = 3
"""Signals during one undisturbed block after which it is left all the same."""


class Interrupt:
    """While it is entered, the first signal sets ``draining`` and the second one interrupts.

    Raises
    ------
    KeyboardInterrupt
        At the second signal, wherever the program is.
    """

    def __init__(self) -> None:
        self.draining = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        self._before = {number: signal.signal(number, self._handle) for number in SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _: object, __: TracebackType | None
    ) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)

    def _handle(self, _: int, __: FrameType | None) -> None:
        if self.draining:
            raise KeyboardInterrupt
        self.draining = True
        with suppress(RuntimeError):  # the signal came while this very stream was written to
            sys.stderr.write("\nending the trials that run; once more stops at once\n")


@contextmanager
def undisturbed() -> Iterator[None]:
    """Hold signals back until the block is over.

    An interrupt in the middle of a transaction could leave the connection open, and its locks to a
    process that nobody can ask any more: this very one.

    Raises
    ------
    KeyboardInterrupt
        In the block, at the third signal: it hangs.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []

    def hold(number: int, _: FrameType | None) -> None:
        held.append(number)
        if len(held) == IMPATIENT:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, hold) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for one in held:
            signal.raise_signal(one)
