"""Progress line of a launch."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from types import TracebackType
from typing import Self, TextIO

from rich.console import Console
from rich.live import Live
from rich.text import Text

LINE_INTERVAL_SECONDS = 10.0
"""Interval of progress lines if the output is not a terminal."""

RATE_WINDOW_SECONDS = 30.0
"""Period over which the rate is averaged."""

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
            self._live = Live(console=console, refresh_per_second=4, get_renderable=self._text)

    def __enter__(self) -> Self:
        if self._live:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _: object, __: TracebackType | None
    ) -> None:
        if self._live:
            self._live.stop()
        elif self._tally.over:
            self._print()

    def update(self) -> None:
        """Record the current tally, and print a line when one is due."""
        now = time.monotonic()
        self._recent.append((now, self._tally.over))
        while len(self._recent) > 2 and self._recent[0][0] < now - RATE_WINDOW_SECONDS:
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

    def _text(self) -> Text:
        return Text(self.line())

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
