"""Commands on a grid that runs: ``status`` and ``work``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from rich.console import RenderableType
from rich.text import Text

from orchestrate.commands import Command, add_filters, chosen, plain, say, say_json, show
from orchestrate.commands.results import STATES, Status, gather, grid_table, seconds_since
from orchestrate.errors import ExitCode, without_password
from orchestrate.program import as_started, length_of_time, positive, tell
from orchestrate.program import say as say_still
from orchestrate.runner.progress import duration
from orchestrate.store import FailureKind, LaunchRow, Reader

MAX_ROWS = 60
"""Rows of the table without --all."""


def _add_status_arguments(parser: argparse.ArgumentParser) -> None:
    add_filters(parser)
    parser.add_argument(
        "--all", action="store_true", help=f"a row for each configuration, also above {MAX_ROWS}"
    )


def _run_status(arguments: argparse.Namespace) -> ExitCode:
    """Print the status."""
    with Reader.open(arguments.db) as reader, reader.moment() as moment:
        status = gather(moment, chosen(moment, arguments))
    if arguments.json:
        say_json(document(status, reader.safe_url))
    elif not status.configs:
        say(f"{reader.safe_url} holds no trials yet: run a launch that writes to it.")
    else:
        show(*parts(status, len(status.configs) if arguments.all else MAX_ROWS))
    return ExitCode.DONE


STATUS_COMMAND = Command(
    "status", "show progress, failures and running launches", _run_status, _add_status_arguments
)


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
    if status.explorations:
        yield Text("\nExplorations", style="bold")
        for one in status.explorations[-_MAX_EXPLORATIONS:]:
            name = f"{one.env}, {one.label}, seed {one.seed}"
            yield plain(f"  {one.trial_key[:12]}  {name}: {one.state}")
    if status.failures:
        yield Text("\nFailures", style="bold red")
        yield from map(_failure, status.failures[:_MAX_KINDS])
        if len(status.failures) > _MAX_KINDS:
            yield Text(f"  and {len(status.failures) - _MAX_KINDS:,} other kinds")
    detached = status.detached if status.left else ()
    if status.launches or detached:
        yield Text("\nLaunches", style="bold")
        for launch in detached:
            where = f"{launch.launch_id} on {launch.host}, {launch.started[:19]}Z"
            yield Text(f"  {where}: registered a grid for workers")
        yield from (_launch(launch, bool(status.left)) for launch in status.launches)
    if status.left and not status.launches:
        again = f"start workers with {WORK}" if detached else "run the same launch command again"
        yield Text(f"\nNo {'worker' if detached else 'launch'} is running: {again} to continue.")


def _failure(kind: FailureKind) -> Text:
    places = sorted(f"{env}/{policy}" for env, policy in kind.places)
    more = [f"and {len(places) - _MAX_PLACES} other places"] if len(places) > _MAX_PLACES else []
    text = Text(f"  {_plural(kind.trials, 'trial')} ({_plural(kind.attempts, 'attempt')}), ")
    text.append(kind.cause, style="red")
    text.append(f": {', '.join([*places[:_MAX_PLACES], *more])}")
    last = kind.last_line or f"{kind.type or ''}: {kind.message or ''}".strip(": ")
    lines = [kind.message] if kind.message and kind.message not in last else []
    for line in filter(None, [*lines, last, kind.place and f"at {kind.place}"]):
        text.append("\n      ").append(plain(_first_line(line)))
    return text


def _launch(launch: LaunchRow, unfinished: bool) -> Text:
    age = duration(max(0.0, seconds_since(launch.started, datetime.now(UTC))))
    since = f"{launch.started[:19]}Z"
    where = f"  {launch.launch_id} on {launch.host}, process {launch.pid}, since {since}"
    worker = launch.kind == "worker"
    if launch.alive:
        return Text(f"{where}: {'worker, ' if worker else ''}alive for {age}")
    hint = "run the same launch command again to continue"
    if worker:
        hint = "other workers take its trials"
    dead = Text(f"{where}: ").append("dead", style="red")
    return dead.append(f"; {hint}") if unfinished else dead


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


def _add_work_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--until",
        type=length_of_time("--until"),
        metavar="TIME",
        help="hold nothing after this time from now, such as 55m, 1h30m or 90s (default: run until "
        "no trial is left)",
    )
    parser.add_argument(
        "--processes",
        type=positive("--processes", int),
        metavar="N",
        help="trials at once (default: one for each core that this process may use)",
    )
    more = "run a trial that exceeds --memory-gib once more, with so many times as much"
    lost = "seconds for which a worker that is lost keeps its trials on PostgreSQL"
    for option, default, shown, text in (
        ("--timeout", 3600.0, None, "seconds that a trial may take"),
        ("--memory-gib", None, "GIB", "memory of one process"),
        ("--retry-memory", None, "FACTOR", more),
        ("--lease", 60.0, None, lost),
    ):
        number = positive(option, float)
        parser.add_argument(option, type=number, default=default, metavar=shown, help=text)


def _run_work(arguments: argparse.Namespace) -> ExitCode:
    """Run trials until none is left, the time is over, or a signal comes."""
    from orchestrate.runner.start import Output
    from orchestrate.runner.worker import run_worker

    names = ("processes", "timeout", "memory_gib", "retry_memory", "lease")
    given = {name: getattr(arguments, name) for name in names}
    output = Output(_to_stderr if arguments.json else say_still, _to_stderr, sys.stderr)
    code = run_worker(arguments.db, output, seconds=arguments.until, **given)
    if arguments.json:
        say_json({"exit_code": code.value, "complete": code in (0, ExitCode.SOME_FAILED)})
    return code


def _to_stderr(line: str) -> None:
    tell(sys.stderr, f"{without_password(line)}\n")


WORK_COMMAND = Command(
    "work", "run registered trials on this machine", _run_work, _add_work_arguments
)
