"""Status of a grid as text, tables and JSON."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from rich.console import RenderableType
from rich.text import Text

from orchestrate.cli_parser import as_started
from orchestrate.commands.configs_table import grid_table
from orchestrate.commands.display import plain
from orchestrate.queries.status import STATES, Status, seconds_since
from orchestrate.redaction import without_password
from orchestrate.runner.progress import duration
from orchestrate.store import ExplorationRow, FailureKind, LaunchRow

WORK = as_started("python -m orchestrate work")
_NAMES = ("env", "policy", "model", "learner", "width", "depth", "horizon", "dt", "gamma")
_CONFIG = ("config_key", *_NAMES, "n", *(f"n_{state}" for state in STATES))
_LAUNCH = ("launch_id", "alive", "host", "pid", "started", "argv")
_FAILURE = ("cause", "type", "message", "trials", "attempts", "last_line", "place")
_MAX_KINDS = 10
_MAX_EXPLORATIONS = 20  # the newest
_MAX_PLACES = 4
_MAX_LINE = 200  # characters of a line of a traceback


def summary(status: Status) -> str:
    """Return the counts, the rate and the estimated remaining time on one line."""
    counts, total = status.counts, status.total
    words = [f"{total - status.left:,} of {total:,} trials have an outcome"]
    words += [f"{counts[name]:,} {name}" for name in counts if counts[name]]
    if status.rate:
        words.append(f"{status.rate:.1f}/s")
    if status.seconds_left is not None:
        words.append(f"{duration(status.seconds_left)} left")
    return " · ".join(words)


def parts(status: Status, max_rows: int) -> Iterator[RenderableType]:
    """Yield the grid in at most ``max_rows`` rows, the failures and the launches."""
    yield grid_table(status.configs, max_rows)
    yield Text(f"\n{summary(status)}", style="bold")
    if status.mixed:
        yield Text(
            f"{_plural(len(status.mixed), 'configuration')} with results of different code "
            f"(the first is {status.mixed[0][:12]}): python -m orchestrate doctor",
            style="yellow",
        )
    if status.rounded:
        yield Text(
            f"{_plural(status.rounded, 'trial')} of ranges of an earlier version, with values such "
            f"as 0.30000000000000004: the same range now gives 0.3, and runs other trials"
        )
    if status.explorations:
        yield Text("\nExplorations", style="bold")
        yield from map(_exploration, status.explorations[-_MAX_EXPLORATIONS:])
    if status.failures:
        yield Text("\nFailures", style="bold red")
        yield from map(_failure, status.failures[:_MAX_KINDS])
        if len(status.failures) > _MAX_KINDS:
            yield Text(f"  and {len(status.failures) - _MAX_KINDS:,} other kinds")
    detached = status.detached if status.left else ()
    if status.launches or detached:
        yield Text("\nLaunches", style="bold")
        yield from map(_detached, detached)
        yield from map(_launch, status.launches)
    if status.left and not status.launches:
        again = f"start workers with {WORK}" if detached else "run the same launch command again"
        yield Text(f"\nNo {'worker' if detached else 'launch'} is running: {again} to continue.")


def _exploration(one: ExplorationRow) -> Text:
    return plain(f"  {one.trial_key[:12]}  {one.env}, {one.label}, seed {one.seed}: {one.state}")


def _failure(kind: FailureKind) -> Text:
    places = sorted(f"{env}/{policy}" for env, policy in kind.places)
    more = [f"and {len(places) - _MAX_PLACES} other places"] if len(places) > _MAX_PLACES else []
    text = Text(f"  {_plural(kind.trials, 'trial')} ({_plural(kind.attempts, 'attempt')}), ")
    text.append(kind.cause, style="red")
    text.append(f": {', '.join([*places[:_MAX_PLACES], *more])}")
    last = kind.last_line or f"{kind.type or ''}: {kind.message or ''}".strip(": ")
    lines = [kind.message] if kind.message and kind.message not in last else []
    for line in [*lines, last, *([f"at {kind.place}"] if kind.place else [])]:
        text.append("\n      ").append(plain(_first_line(line)))
    return text


def _detached(launch: LaunchRow) -> Text:
    since = f"{launch.started[:19]}Z"
    return Text(f"  {launch.launch_id} on {launch.host}, {since}: registered a grid for workers")


def _launch(launch: LaunchRow) -> Text:
    age = duration(max(0.0, seconds_since(launch.started, datetime.now(UTC))))
    since = f"{launch.started[:19]}Z"
    where = f"  {launch.launch_id} on {launch.host}, process {launch.pid}, since {since}"
    worker = launch.kind == "worker"
    if launch.alive:
        return Text(f"{where}: {'worker, ' if worker else ''}alive for {age}")
    hint = "run the same launch command again to continue"
    if worker:
        hint = "other workers take its trials"
    return Text(f"{where}: ").append("dead", style="red").append(f"; {hint}")


def document(status: Status, database: str) -> dict[str, Any]:
    """Return the status as a JSON document."""
    launches = [{name: getattr(one, name) for name in _LAUNCH} for one in status.launches]
    for launch in launches:
        launch["argv"] = [without_password(word) for word in launch["argv"]]
    return {
        "database": database,
        "trials": {"all": status.total, **status.counts},
        "complete": not status.left,
        "per_second": status.rate,
        "seconds_left": status.seconds_left,
        "configs": [{name: getattr(one, name) for name in _CONFIG} for one in status.configs],
        "failures": [
            {**{name: getattr(kind, name) for name in _FAILURE}, "places": sorted(kind.places)}
            for kind in status.failures
        ],
        "launches": launches,
        "detached": [one.launch_id for one in status.detached],
        "explorations": [asdict(one) for one in status.explorations],
        "mixed_code": list(status.mixed),
    }


def _plural(number: int, noun: str) -> str:
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def _first_line(text: str) -> str:
    line = text.strip().splitlines()[0] if text.strip() else ""
    return line if len(line) <= _MAX_LINE else f"{line[: _MAX_LINE - 1]}…"
