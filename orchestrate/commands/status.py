"""``status``: how far the grid is, what failed and why, who works on it and for how long."""

from __future__ import annotations

import argparse

from orchestrate.commands.command import Command
from orchestrate.commands.display import show
from orchestrate.commands.filtering import add_filters, chosen
from orchestrate.commands.output import say, say_json
from orchestrate.commands.parser import positive
from orchestrate.commands.status_view import document, parts
from orchestrate.commands.watching import watch
from orchestrate.errors import ExitCode
from orchestrate.status import Status, gather
from orchestrate.store import Reader

ROWS = 60
"""Rows of the table, unless --all asks for every configuration."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_filters(parser)
    parser.add_argument("--all", action="store_true", help=f"a row for each, also above {ROWS}")
    parser.add_argument(
        "--watch",
        nargs="?",
        type=positive("--watch", float),
        const=0.0,
        metavar="SECONDS",
        help="show it again and again until the grid is complete: every 2 s in a terminal, a line "
        "every 10 s elsewhere; exit code 1 if trials failed",
    )


def run(arguments: argparse.Namespace) -> ExitCode:
    """Show the status once, or until the grid is complete."""
    with Reader.open(arguments.db) as reader:
        if arguments.watch is None:
            status = _look(reader, arguments)
            _show(status, arguments, reader.safe_url)
            return ExitCode.DONE
        status = watch(lambda: _look(reader, arguments), arguments.watch, quiet=arguments.json)
        if arguments.json:
            _show(status, arguments, reader.safe_url)
        return ExitCode.SOME_FAILED if status.counts["failed"] else ExitCode.DONE


def _show(status: Status, arguments: argparse.Namespace, database: str) -> None:
    if arguments.json:
        say_json(document(status, database))
    elif not status.cells:
        say(f"{database} holds no trials yet: run a launch that writes to it.")
    else:
        show(*parts(status, len(status.cells) if arguments.all else ROWS))


def _look(reader: Reader, arguments: argparse.Namespace) -> Status:
    with reader.moment() as moment:
        return gather(moment, chosen(moment, arguments))


COMMAND = Command("status", "show how far the grid is, what failed and why", add_arguments, run)
