"""Repeated status: in place on a terminal, as lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator

from rich.console import Group
from rich.live import Live
from rich.text import Text

from orchestrate.commands.display import console
from orchestrate.commands.output import say
from orchestrate.commands.status_view import parts, summary
from orchestrate.queries.status import Status
from orchestrate.store import StoreUnavailableError

TERMINAL_INTERVAL_SECONDS = 2.0
LINE_INTERVAL_SECONDS = 10.0

_LINES_BESIDE_GRID = 14  # of the screen, above and below the grid

Read = Callable[[], Status]


def watch(read: Read, seconds: float | None, quiet: bool) -> Status:
    """Show what ``read`` returns until every trial has an outcome; return the last status.

    A database that cannot be reached is read again later.
    """
    terminal = sys.stdout.isatty() and not quiet
    statuses = _statuses(
        read, seconds or (TERMINAL_INTERVAL_SECONDS if terminal else LINE_INTERVAL_SECONDS)
    )
    if terminal:
        _in_place(statuses)
    else:
        for status in statuses:
            if not quiet:
                say(status if isinstance(status, str) else summary(status))
    return read()


def _statuses(read: Read, seconds: float) -> Iterator[Status | str]:
    """Yield the status, or the error of a failed read, until the grid is complete."""
    while True:
        try:
            status = read()
        except StoreUnavailableError as error:
            if not error.transient:
                raise
            yield str(error)
        else:
            yield status
            if status.configs and not status.left:
                return
        time.sleep(seconds)


def _in_place(statuses: Iterable[Status | str]) -> None:
    screen = console()
    with Live(console=screen, auto_refresh=False) as live:
        for status in statuses:
            rows = max(4, screen.height - _LINES_BESIDE_GRID)
            shown = Text(status) if isinstance(status, str) else Group(*parts(status, rows))
            live.update(shown, refresh=True)
