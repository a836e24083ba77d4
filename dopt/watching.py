"""Losses of a trial while it runs, told to whoever watches it.

Watching changes no number of a trial. Where nobody watches, it costs nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from dopt.types import Array

Tell = Callable[[int, Array, Array], None]
"""Takes a step t and, for each of the n trials that run together, the losses after it, (n,) each.

They are those over the evaluation grid and over the reachable set, NaN for a trial that diverged.
"""


class Watch:
    """Calls ``tell`` about every ``seconds`` of wall time [s] with the newest losses."""

    def __init__(self, seconds: float, tell: Tell) -> None:
        self.seconds = seconds
        self._tell = tell
        self._next = time.monotonic() + seconds

    def look(self, t: int, loss: Array, reachable_loss: Array) -> None:
        """Tell the losses after step t, (n,) each, unless others were told a short time ago."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + self.seconds
            self._tell(t, loss, reachable_loss)


_current: ContextVar[Watch | None] = ContextVar("watch", default=None)


@contextmanager
def watched(seconds: float, tell: Tell) -> Iterator[None]:
    """Watch the trials that run in the block; an exception of ``tell`` ends the trial."""
    token = _current.set(Watch(seconds, tell))
    try:
        yield
    finally:
        _current.reset(token)


def current_watch() -> Watch | None:
    """Return the watch over the trial that runs, or None."""
    return _current.get()
