"""Progress of a launch on the terminal, and the signals that end it."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from types import FrameType
from typing import Self, TextIO

from rich.console import Console
from rich.live import Live
from rich.text import Text

LINE_INTERVAL_SECONDS = 10.0
"""Interval of progress lines if the output is not a terminal."""

RATE_WINDOW_SECONDS = 30.0
"""Period over which the rate is averaged, at most."""

SLOW_SHARE = 1 / 3
"""Share of the outcomes so far, the first ones, that do not count for the rate: workers start."""

SHARE_BEFORE_ESTIMATE = 0.1
"""Share of the trials of a launch before which its rate, of workers that start, says nothing."""


@dataclass
class Tally:
    """Counts of the outcomes of a grid.

    Attributes
    ----------
    total
        Trials of the grid.
    before, failed_before
        Trials that other launches finished, and the failed ones among them.
    done, diverged, failed
        Outcomes of this launch.
    """

    total: int
    before: int = 0
    failed_before: int = 0
    done: int = 0
    diverged: int = 0
    failed: int = 0

    @property
    def over(self) -> int:
        """Trials with an outcome of this launch."""
        return self.done + self.diverged + self.failed

    @property
    def left(self) -> int:
        """Trials without an outcome."""
        return self.total - self.before - self.over

    @property
    def all_failed(self) -> int:
        """Failed trials of the grid, whichever launch ran them."""
        return self.failed_before + self.failed


class Progress:
    """Display of a tally: in place on a terminal, as lines elsewhere, or none."""

    def __init__(self, tally: Tally, stream: TextIO | None) -> None:
        self._tally = tally
        self._stream = stream
        self._recent = deque([(time.monotonic(), tally.over)])
        self._shown = time.monotonic()
        self._live: Live | None = None
        if stream and stream.isatty():
            console = Console(file=stream)
            self._live = Live(
                console=console, refresh_per_second=4, get_renderable=lambda: Text(self.line())
            )

    def __enter__(self) -> Self:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()
        elif self._tally.over:
            self._print()

    def update(self) -> None:
        """Record the current tally, and print a line when one is due."""
        now = time.monotonic()
        self._recent.append((now, self._tally.over))
        slow = SLOW_SHARE * self._tally.over
        while len(self._recent) > 2 and (
            self._recent[0][0] < now - RATE_WINDOW_SECONDS or self._recent[1][1] <= slow
        ):
            self._recent.popleft()
        if self._live is None and now - self._shown >= LINE_INTERVAL_SECONDS:
            self._shown = now
            self._print()

    def line(self) -> str:
        """Return the tally, the rate and the estimated remaining time, once that is known."""
        tally = self._tally
        (start, before), (end, over) = self._recent[0], self._recent[-1]
        rate = (over - before) / (end - start) if end > start else 0.0
        words = [
            f"{tally.before + tally.over:,} of {tally.total:,}",
            f"{tally.done:,} done now",
            f"{tally.all_failed:,} failed",
            f"{tally.diverged:,} diverged",
            f"{rate:.1f}/s",
        ]
        known = tally.over >= SHARE_BEFORE_ESTIMATE * (tally.over + tally.left)
        if tally.left and rate and known:
            words.append(f"{duration(tally.left / rate)} left")
        return " · ".join(words)

    def _print(self) -> None:
        if self._stream:
            self._stream.write(f"{self.line()}\n")
            self._stream.flush()


def duration(seconds: float) -> str:
    """Return a readable duration, such as ``2 min 05 s``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02} min"
    return f"{minutes} min {rest:02} s" if minutes else f"{rest} s"


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


@contextmanager
def handling(
    numbers: Sequence[signal.Signals], handler: Callable[[int, FrameType | None], None]
) -> Iterator[None]:
    """Let ``handler`` take the signals in the block."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


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
        self._handled = ExitStack()
        self._repeated = Repetition()

    def __enter__(self) -> Self:
        self._handled.enter_context(handling(self._signals, self._handle))
        return self

    def __exit__(self, *_: object) -> None:
        self._handled.close()

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

    # SIGUSR1 belongs to whoever uses it, except where a handler is set as ours are.
    used = [signal.SIGUSR1] if callable(signal.getsignal(signal.SIGUSR1)) else []
    try:
        with handling((*SIGNALS, *used), hold):
            yield
    finally:
        for one in held:
            signal.raise_signal(one)
