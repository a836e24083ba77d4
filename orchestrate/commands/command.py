"""A command of ``python -m orchestrate``: its name, its arguments, and what it does."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass

from orchestrate.commands.parser import Parser
from orchestrate.errors import ExitCode

PROGRAM = "python -m orchestrate"
DEFAULT_URL = "sqlite:///results/results.db"


@dataclass(frozen=True)
class Command:
    """One word after ``python -m orchestrate``.

    Attributes
    ----------
    help
        One line for the list of commands.
    add_arguments
        Adds what this command takes beside ``--db`` and ``--json``.
    run
        Does it and returns the exit code. With ``arguments.json`` it writes one JSON document to
        the standard output and nothing else. A ``DoptError`` that it raises is printed as a
        sentence: exit code 75 for ``StoreUnavailableError``, 2 for the others.
    """

    name: str
    help: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], ExitCode]

    def parser(self) -> Parser:
        """Return the parser of the words after the name of the command."""
        parser = Parser(prog=f"{PROGRAM} {self.name}", description=self.help)
        self.add_arguments(parser)
        parser.add_argument(
            "--db",
            metavar="URL",
            default=os.environ.get("DOPT_DB") or DEFAULT_URL,
            help=f"database (the variable DOPT_DB, else {DEFAULT_URL})",
        )
        parser.add_argument("--json", action="store_true", help="print one JSON document")
        return parser
