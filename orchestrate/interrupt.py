"""Ctrl-C: once lets what runs end, twice stops at once."""

from __future__ import annotations

import signal
import sys
from contextlib import suppress
from types import FrameType, TracebackType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM)


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
