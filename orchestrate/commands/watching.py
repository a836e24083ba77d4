"""The status again and again: in place on a terminal, as lines elsewhere."""

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
from orchestrate.status import Status
from orchestrate.store import StoreUnavailableError

IN_PLACE = 2.0
LINES = 10.0
"""Seconds between two looks."""

_OTHER_LINES = 14  # of the screen, for what stands above and below the grid

Look = Callable[[], Status]


def watch(look: Look, seconds: float | None, quiet: bool) -> Status:
    """Show what ``look`` returns until every trial has an outcome, and return the last of it.

    A database that goes away for a while is waited for.
    """
    terminal = sys.stdout.isatty() and not quiet
    looks = _looks(look, seconds or (IN_PLACE if terminal else LINES))
    if terminal:
        _in_place(looks)
    else:
        for status in looks:
            if not quiet:
                say(status if isinstance(status, str) else summary(status))
    return look()


def _looks(look: Look, seconds: float) -> Iterator[Status | str]:
    """Yield status after status, or why there is none now, until the grid is complete."""
    while True:
        try:
            status = look()
        except StoreUnavailableError as error:
            if not error.transient:
                raise
            yield str(error)
        else:
            yield status
            if status.cells and not status.left:
                return
        time.sleep(seconds)


def _in_place(looks: Iterable[Status | str]) -> None:
    screen = console()
    with Live(console=screen, auto_refresh=False) as live:
        for status in looks:
            rows = max(4, screen.height - _OTHER_LINES)
            shown = Text(status) if isinstance(status, str) else Group(*parts(status, rows))
            live.update(shown, refresh=True)
