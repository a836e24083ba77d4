"""Commands on a results database: their interface, output and filters.

A new command is a :class:`Command` in a module here and a line in
:data:`orchestrate.__main__.COMMANDS`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from dopt.errors import unknown_name
from orchestrate.errors import ExitCode
from orchestrate.program import Parser, UsageError, as_started, tell, visible
from orchestrate.store import DEFAULT_URL, URL_VARIABLE, ConfigRow, Reader, default_url
from orchestrate.store.records import jsonable

PROGRAM = as_started("python -m orchestrate")


@dataclass(frozen=True)
class Command:
    """Command: the first argument after ``python -m orchestrate``.

    Attributes
    ----------
    help
        One line for the list of commands.
    run
        Runs the command and returns the exit code. With ``arguments.json`` it writes one JSON
        document to the standard output and nothing else. A ``DoptError`` is printed as one line,
        with exit code 75 for ``StoreUnavailableError`` and 2 for the others.
    add_arguments
        Adds the arguments of the command, beside ``--db`` and ``--json``.
    needs_database
        Whether the command has ``--db``.
    """

    name: str
    help: str
    run: Callable[[argparse.Namespace], ExitCode]
    add_arguments: Callable[[argparse.ArgumentParser], None] = lambda _: None
    needs_database: bool = True

    def parser(self) -> Parser:
        """Return the parser of the arguments after the name of the command."""
        parser = Parser(prog=f"{PROGRAM} {self.name}", description=self.help)
        self.add_arguments(parser)
        if self.needs_database:
            parser.add_argument(
                "--db",
                metavar="URL",
                default=default_url(),
                help=f"database (default: the variable {URL_VARIABLE}, else {DEFAULT_URL})",
            )
        parser.add_argument("--json", action="store_true", help="print one JSON document")
        return parser


def say(text: str) -> None:
    """Print a line and flush it."""
    tell(sys.stdout, f"{text}\n")


def answer(arguments: argparse.Namespace, document: Any, text: str) -> ExitCode:
    """Print the document with ``--json`` and the text without; return the code of a success."""
    if arguments.json:
        say_json(document)
    else:
        say(text)
    return ExitCode.DONE


def say_json(document: Any) -> None:
    """Print one JSON document; numbers that are not finite are null, bytes are base64."""
    say(json.dumps(jsonable(document), indent=2, allow_nan=False))


_UNLIMITED_WIDTH = 100_000  # characters: no line is folded or cut


class _Console(Console):
    """Console that shows the control characters of texts, and sends its own."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        for one in super().render(renderable, options):
            yield one if one.control else Segment(visible(one.text), one.style)


def console() -> Console:
    """Return a console on the standard output; colours follow NO_COLOR and the terminal."""
    width = None if sys.stdout.isatty() else _UNLIMITED_WIDTH
    return _Console(file=sys.stdout, width=width, highlight=False, markup=False, emoji=False)


def show(*parts: RenderableType) -> None:
    """Print the parts below each other; a table may be wider than the terminal."""
    out = console()
    for part in parts:
        if isinstance(part, Table):
            out.width = max(out.width, out.measure(part).minimum)
        out.print(part, soft_wrap=isinstance(part, str | Text))


def table(
    heads: Sequence[str],
    *,
    numbers: Collection[str] = (),
    styles: Sequence[str] = (),
    footers: Sequence[str] = (),
) -> Table:
    """Return an empty table whose cells do not wrap; columns in ``numbers`` are right-aligned."""
    result = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_footer=bool(footers))
    for i, head in enumerate(heads):
        result.add_column(
            head,
            footer=footers[i] if footers else "",
            justify="right" if head in numbers else "left",
            style=styles[i] if styles else "",
            no_wrap=True,
            overflow="ignore",
        )
    return result


def plain(text: str) -> Text:
    """Return the text with control characters escaped."""
    return Text(visible(text.expandtabs()))


def add_filters(parser: argparse.ArgumentParser) -> None:
    """Add the options that select a part of the grid."""
    parser.add_argument("--env", nargs="+", default=(), help="only these environments")
    parser.add_argument("--policy", nargs="+", default=(), help="only these policies")


def chosen(reader: Reader, arguments: argparse.Namespace) -> list[ConfigRow]:
    """Return the configurations that the options select; all without options.

    Raises ``UsageError`` for a name that no configuration has.
    """
    configs = reader.configs()
    for column in ("env", "policy"):
        names, known = getattr(arguments, column), {getattr(one, column) for one in configs}
        for name in names:
            if known and name not in known:
                raise UsageError(str(unknown_name(column, name, known)))
        configs = [one for one in configs if not names or getattr(one, column) in names]
    return configs
