"""Command ``query "SELECT ..."``: a read-only SQL query with a limit of rows and time."""

from __future__ import annotations

import argparse
import csv
import io
import sys

from orchestrate.cli_parser import positive, tell
from orchestrate.commands.command import Command
from orchestrate.commands.display import plain, show, table
from orchestrate.commands.output import jsonable, say_json
from orchestrate.errors import ExitCode
from orchestrate.store import Reader, Table

DEFAULT_LIMIT = 1_000
DEFAULT_TIMEOUT_SECONDS = 60.0
_MAX_TEXT = 60  # characters of a value in a table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sql", metavar="SQL", help="one SELECT; docs/database.md has examples")
    parser.add_argument("--csv", action="store_true", help="print comma-separated values")
    parser.add_argument(
        "--limit",
        type=positive("--limit", int),
        help=f"most rows ({DEFAULT_LIMIT:,} in a table, all of them as CSV or JSON)",
    )
    parser.add_argument(
        "--timeout",
        type=positive("--timeout", float),
        default=DEFAULT_TIMEOUT_SECONDS,
        metavar="SECONDS",
        help=f"end the query after this time ({DEFAULT_TIMEOUT_SECONDS:g})",
    )


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print the rows, and a note on the standard error if there are more."""
    whole = arguments.csv or arguments.json
    limit = arguments.limit or (None if whole else DEFAULT_LIMIT)
    with Reader.open(arguments.db) as reader:
        rows = reader.query(arguments.sql, limit, arguments.timeout)
    if arguments.json:
        say_json({"columns": rows.columns, "rows": [list(row) for row in rows], "cut": rows.cut})
    elif arguments.csv:
        _write_csv(rows)
    else:
        _show(rows)
    if rows.cut:
        more = "--limit N gives more" if whole else "--limit N gives more, --csv gives all"
        sys.stderr.write(f"note: only the first {len(rows):,} rows are shown, {more}.\n")
    return ExitCode.DONE


def _write_csv(rows: Table) -> None:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(rows.columns)
    writer.writerows([jsonable(value) for value in row] for row in rows)
    tell(sys.stdout, out.getvalue(), exact=True)


def _show(rows: Table) -> None:
    numbers = {
        name
        for i, name in enumerate(rows.columns)
        if all(isinstance(row[i], int | float | None) for row in rows)
    }
    result = table(rows.columns, numbers=numbers)
    for row in rows:
        result.add_row(*(plain(_text(value)) for value in row))
    show(result)


def _text(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, bytes | memoryview):
        return f"({len(value):,} bytes)"
    line = " ".join(str(jsonable(value)).split())
    return line if len(line) <= _MAX_TEXT else f"{line[: _MAX_TEXT - 1]}…"


COMMAND = Command("query", "run a read-only SQL query", add_arguments, run)
