"""The status of a grid in words, tables and JSON."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

from rich.console import RenderableType
from rich.text import Text

from orchestrate.commands.cells_table import grid_table
from orchestrate.commands.display import plain
from orchestrate.passwords import without_password
from orchestrate.progress import duration
from orchestrate.status import STATES, FailureKind, Status, seconds_since
from orchestrate.store import LaunchRow

_NAMES = ("env", "policy", "model", "learner", "width", "depth", "horizon", "dt", "gamma")
_CELL = ("config_key", *_NAMES, "n", *(f"n_{state}" for state in STATES))
_LAUNCH = ("launch_id", "alive", "host", "pid", "started", "argv")
_FAILURE = ("cause", "type", "message", "trials", "attempts", "last_line", "place")
_KINDS = 10
_PLACES = 4
_WIDEST = 200  # characters of a line of a traceback


def summary(status: Status) -> str:
    """Return the counts, the rate and the time that is left, on one line."""
    counts, total = status.counts, status.total
    words = [f"{total - status.left:,} of {total:,} trials have an outcome"]
    words += [f"{counts[name]:,} {name}" for name in counts if counts[name]]
    if status.rate:
        words.append(f"{status.rate:.1f}/s")
    if status.seconds_left is not None:
        words.append(f"{duration(status.seconds_left)} left")
    return " · ".join(words)


def parts(status: Status, most: int) -> Iterator[RenderableType]:
    """Yield what is to be shown: the grid in at most ``most`` rows, failures, launches."""
    yield grid_table(status.cells, most)
    yield Text(f"\n{summary(status)}", style="bold")
    if status.failures:
        yield Text("\nFailures", style="bold red")
        yield from map(_failure, status.failures[:_KINDS])
        if len(status.failures) > _KINDS:
            yield Text(f"  and {len(status.failures) - _KINDS:,} other kinds")
    if status.launches:
        yield Text("\nLaunches", style="bold")
        yield from map(_launch, status.launches)
    elif status.left:
        yield Text("\nNo launch is running: the same command as before goes on with the rest.")


def _failure(kind: FailureKind) -> Text:
    places = sorted(f"{env}/{policy}" for env, policy in kind.cells)
    more = [f"and {len(places) - _PLACES} other places"] if len(places) > _PLACES else []
    text = Text(f"  {_plural(kind.trials, 'trial')} ({_plural(kind.attempts, 'attempt')}), ")
    text.append(kind.cause, style="red")
    text.append(f": {', '.join([*places[:_PLACES], *more])}")
    last = kind.last_line or f"{kind.type or ''}: {kind.message or ''}".strip(": ")
    lines = [kind.message] if kind.message and kind.message not in last else []
    for line in [*lines, last, *([f"at {kind.place}"] if kind.place else [])]:
        text.append("\n      ").append(plain(_first_line(line)))
    return text


def _launch(launch: LaunchRow) -> Text:
    age = duration(max(0.0, seconds_since(launch.started, datetime.now(UTC))))
    since = f"{launch.started[:19]}Z"
    where = f"  {launch.launch_id} on {launch.host}, process {launch.pid}, since {since}"
    if launch.alive:
        return Text(f"{where}: alive for {age}")
    return (
        Text(f"{where}: ")
        .append("dead", style="red")
        .append("; the same command goes on with its trials")
    )


def document(status: Status, database: str) -> dict[str, Any]:
    """Return the status for a program."""
    launches = [{name: getattr(one, name) for name in _LAUNCH} for one in status.launches]
    for launch in launches:
        launch["argv"] = [without_password(word) for word in launch["argv"]]
    return {
        "database": database,
        "trials": {"all": status.total, **status.counts},
        "complete": not status.left,
        "per_second": status.rate,
        "seconds_left": status.seconds_left,
        "cells": [{name: getattr(cell, name) for name in _CELL} for cell in status.cells],
        "failures": [
            {**{name: getattr(kind, name) for name in _FAILURE}, "cells": sorted(kind.cells)}
            for kind in status.failures
        ],
        "launches": launches,
    }


def _plural(number: int, noun: str) -> str:
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def _first_line(text: str) -> str:
    line = text.strip().splitlines()[0] if text.strip() else ""
    return line if len(line) <= _WIDEST else f"{line[: _WIDEST - 1]}…"
