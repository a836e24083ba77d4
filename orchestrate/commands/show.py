"""Command ``show TRIAL``: contents of the database about one trial."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from orchestrate.cli_parser import integer
from orchestrate.commands.command import Command
from orchestrate.commands.display import plain, show, table
from orchestrate.commands.filtering import add_filters
from orchestrate.commands.output import say_json
from orchestrate.commands.sparkline import sparkline
from orchestrate.commands.trials import describe, listed, the_one
from orchestrate.errors import ExitCode
from orchestrate.queries.trial import TrialReport, report
from orchestrate.store import Reader

_BYTES_PER_MIB = 2**20
_ATTEMPT = ("attempt", "launch", "outcome", "cause", "node", "ended", "wall s", "cpu s", "peak MiB")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("trial", metavar="TRIAL", nargs="?", help="first digits of the trial's key")
    add_filters(parser)
    parser.add_argument("--width", type=integer("--width"), help="the trial of this width")
    parser.add_argument("--seed", type=integer("--seed"), help="the trial of this seed")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print the one trial that the options select."""
    with Reader.open(arguments.db) as reader, reader.moment() as moment:
        rows = listed(moment, arguments, width=arguments.width, seed=arguments.seed)
        row = the_one(rows, arguments.trial)
        found = report(moment, row.trial_id)
    if arguments.json:
        say_json(asdict(found))
    else:
        show(Text(describe(row), style="bold"), *_parts(found))
    return ExitCode.DONE


def _parts(found: TrialReport) -> Iterator[RenderableType]:
    yield _outcome(found)
    if line := sparkline(found.loss):
        kind = "prequential loss" if found.exploration else "loss"
        yield Text(f"{kind}, log scale, {len(found.loss)} steps  {line}")
    yield Text("\nConfiguration", style="bold")
    yield from _configuration(found.config)
    for launch in found.launches:
        yield from _launch(launch)
    if found.attempts:
        yield Text("\nAttempts", style="bold")
        yield _attempts(found)
    errors = [attempt for attempt in found.attempts if attempt["traceback"]]
    if errors:
        yield Text(f"\nTraceback of attempt {errors[-1]['attempt']}", style="bold red")
        yield plain(errors[-1]["traceback"].rstrip())


def _outcome(found: TrialReport) -> Text:
    trial = found.trial
    words = [found.exploration.state if found.exploration else trial["status"]]
    if trial["diverged_at"] is not None:
        words.append(f"at step {trial['diverged_at']:,}")
    words += [
        f"{name.replace('_', ' ')} {trial[name]:.6g}"
        for name in ("final_loss", "best_loss")
        if trial[name] is not None
    ]
    words += [
        f"{name} {value:.6g}" for name, value in found.beyond_limits.items() if value is not None
    ]
    if trial["error_type"] is not None:
        words.append(f"{trial['error_type']}: {trial['error_message']}")
    return plain(" · ".join(words))


def _configuration(config: Mapping[str, Any]) -> Iterator[Text]:
    scalars = {name: value for name, value in config.items() if not isinstance(value, Mapping)}
    sections = {name: value for name, value in config.items() if isinstance(value, Mapping)}
    for name, section in {**sections, "": scalars}.items():
        if section:
            words = " ".join(f"{key}={value}" for key, value in section.items())
            yield plain(f"  {name:<8} {words}")


def _launch(launch: Mapping[str, Any]) -> Iterator[Text]:
    yield Text(f"\nLaunch {launch['launch_id']}", style="bold")
    commit = launch["git_commit"] or "no repository"
    if launch["git_dirty"]:
        commit += f", with changes (diff {str(launch['git_diff_hash'])[:12]})"
    state = "dead" if launch["state"] == "running" and not launch["alive"] else launch["state"]
    until = f"to {launch['ended']}" if launch["ended"] else ""
    lines = {
        "command": shlex.join(launch["argv"]),
        "state": f"{state}, from {launch['started']} {until}".rstrip(),
        "host": f"{launch['host']}, process {launch['pid']}",
        "commit": commit,
        "versions": " ".join(f"{name}={value}" for name, value in launch["versions"].items()),
    }
    yield from (plain(f"  {name:<8} {value}") for name, value in lines.items())


def _attempts(found: TrialReport) -> Table:
    result = table(_ATTEMPT, numbers={"attempt", "launch", "wall s", "cpu s", "peak MiB"})
    for one in found.attempts:
        memory = one["peak_memory_bytes"]
        values = [
            *(one["attempt"], one["launch_id"], one["outcome"] or "running", one["cause"]),
            *(one["node"], (one["ended"] or "")[:19]),
            *(_number(one["wall_seconds"]), _number(one["cpu_seconds"])),
            _number(memory / _BYTES_PER_MIB if memory is not None else None),
        ]
        result.add_row(*(plain("-" if value in (None, "") else str(value)) for value in values))
    return result


def _number(value: float | None) -> str | None:
    return None if value is None else f"{value:,.2f}"


COMMAND = Command(
    "show", "show one trial: configuration, launches, attempts, loss", add_arguments, run
)
