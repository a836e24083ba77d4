"""Command ``backup FILE``: a consistent copy of the database, while launches write to it."""

from __future__ import annotations

import argparse

from orchestrate.cli_parser import path
from orchestrate.commands.command import Command
from orchestrate.commands.output import say, say_json
from orchestrate.errors import ExitCode
from orchestrate.store.backup import back_up


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file",
        type=path("FILE"),
        metavar="FILE",
        help="new file: a database of SQLite, or an archive of PostgreSQL for pg_restore",
    )


def run(arguments: argparse.Namespace) -> ExitCode:
    """Write the file and print its size."""
    size = back_up(arguments.db, arguments.file)
    if arguments.json:
        say_json({"file": str(arguments.file), "bytes": size})
    else:
        say(f"{arguments.file}: {size:,} bytes")
    return ExitCode.DONE


COMMAND = Command("backup", "copy the database to a file", add_arguments, run)
