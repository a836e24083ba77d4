"""Ctrl-C while a program starts: the exit code of an interrupt, and no traceback.

Some libraries make another error of a ``KeyboardInterrupt`` while they are imported, as Hydra does
while it composes. A program imports this module, which loads little, before all others.
"""

from __future__ import annotations

import os
import signal


def _end(*_: object) -> None:
    os._exit(130)  # ExitCode.INTERRUPTED, whose module loads more


def end_at_interrupt() -> None:
    """Let Ctrl-C end this process, unless it is ignored or handled."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def raise_at_interrupt() -> None:
    """Let Ctrl-C raise ``KeyboardInterrupt`` again: from here on something has to be closed."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)
