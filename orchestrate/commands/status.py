"""Command ``status``: progress of the grid, failures and running launches."""

from __future__ import annotations

import argparse

from orchestrate.cli_parser import positive
from orchestrate.commands.command import Command
from orchestrate.commands.display import show
from orchestrate.commands.filtering import add_filters, chosen
from orchestrate.commands.output import say, say_json
from orchestrate.commands.status_view import document, parts
from orchestrate.commands.watching import watch
from orchestrate.errors import ExitCode
from orchestrate.queries.status import Status, gather
from orchestrate.store import Reader

MAX_ROWS = 60
"""Rows of the table without --all."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_filters(parser)
    parser.add_argument(
        "--all", action="store_true", help=f"a row for each configuration, also above {MAX_ROWS}"
    )
    parser.add_argument(
        "--watch",
        nargs="?",
        type=positive("--watch", float),
        const=0.0,
        metavar="SECONDS",
        help="repeat until the grid is complete: every 2 s in a terminal, one line every 10 s "
        "elsewhere; exit code 1 if trials failed",
    )


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print the status once, or until the grid is complete."""
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
    elif not status.configs:
        say(f"{database} holds no trials yet: run a launch that writes to it.")
    else:
        show(*parts(status, len(status.configs) if arguments.all else MAX_ROWS))


def _look(reader: Reader, arguments: argparse.Namespace) -> Status:
    with reader.moment() as moment:
        return gather(moment, chosen(moment, arguments))


COMMAND = Command("status", "show progress, failures and running launches", add_arguments, run)
