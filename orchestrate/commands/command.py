"""Interface of a command of ``python -m orchestrate``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass

from orchestrate.cli_parser import Parser, as_started
from orchestrate.errors import ExitCode
from orchestrate.store import DEFAULT_URL, URL_VARIABLE, default_url

PROGRAM = as_started("python -m orchestrate")


@dataclass(frozen=True)
class Command:
    """Command: the first argument after ``python -m orchestrate``.

    Attributes
    ----------
    help
        One line for the list of commands.
    add_arguments
        Adds the arguments of the command, beside ``--db`` and ``--json``.
    run
        Runs the command and returns the exit code. With ``arguments.json`` it writes one JSON
        document to the standard output and nothing else. A ``DoptError`` is printed as one line,
        with exit code 75 for ``StoreUnavailableError`` and 2 for the others.
    """

    name: str
    help: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], ExitCode]

    def parser(self) -> Parser:
        """Return the parser of the arguments after the name of the command."""
        parser = Parser(prog=f"{PROGRAM} {self.name}", description=self.help)
        self.add_arguments(parser)
        parser.add_argument(
            "--db",
            metavar="URL",
            default=default_url(),
            help=f"database (default: the variable {URL_VARIABLE}, else {DEFAULT_URL})",
        )
        parser.add_argument("--json", action="store_true", help="print one JSON document")
        return parser
