"""``python -m studies.yardsticks``: published tables, run here, beside the published numbers."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from analysis import outputs
from analysis.cli import add_database, add_selection, wanted
from analysis.data.matching import AnalysisError, Filter, IncompleteError
from analysis.data.selection import Entry, Selection
from analysis.tables.rendering import TextTable
from orchestrate.program import Parser, answered, path, run, tell
from orchestrate.store import Reader
from studies.yardsticks import disk, pendulums, star, swing_up

HELP = "published tables, run here, beside the published numbers"


@dataclass(frozen=True)
class Yardstick:
    """A published table: its experiment, its trials in a database, and what is made of them."""

    name: str
    entries: Callable[[Reader, Filter], list[Entry]]
    measure: Callable[[Reader, Iterable[Entry]], pd.DataFrame]
    tabulate: Callable[[pd.DataFrame], pd.DataFrame]
    tables: Callable[[pd.DataFrame], Sequence[TextTable]]


YARDSTICKS = tuple(
    Yardstick(rows.NAME, rows.entries, rows.measure, rows.tabulate, rows.tables)
    for rows in (swing_up, pendulums, star, disk)
)


@answered
def main(words: Sequence[str] | None = None) -> int:
    """Print the tables of which there are trials, and write their files; 0."""
    parser = Parser(prog="python -m studies.yardsticks", description=HELP)
    add_database(parser)
    add_selection(parser)
    parser.add_argument(
        "--out", type=path("--out"), default="yardsticks", help="folder (yardsticks/)"
    )
    options = parser.read(sys.argv[1:] if words is None else words)
    try:
        _write_tables(options)
    except IncompleteError as error:
        tell(sys.stderr, f"{error}\n")
        return 3
    return 0


def _write_tables(options: argparse.Namespace) -> None:
    with Reader.open(options.db) as reader, reader.moment() as moment:
        found = [(one, one.entries(moment, wanted(options))) for one in YARDSTICKS]
        found = [(one, entries) for one, entries in found if entries]
        if not found:
            names = " or ".join(one.name for one in YARDSTICKS)
            raise AnalysisError(
                f"{moment.safe_url} holds no trials of a published table: run "
                f"orchestrate/launch.py -m experiment={names} first."
            )
        for one, entries in found:
            _check_finished(one, entries, allowed=options.allow_partial)
        parts = [table for each in found for table in _written(moment, *each, options.out)]
    tell(sys.stdout, "\n".join(part.markdown() for part in parts))


def _check_finished(one: Yardstick, entries: Iterable[Entry], *, allowed: bool) -> None:
    unfinished = sum(len(entry.trials) - len(entry.finished) for entry in entries)
    if unfinished and not allowed:
        raise IncompleteError(
            f"error: {unfinished} trials of {one.name} are not finished, a complete grid is "
            f"expected: run the launch again, or give --allow-partial to go on with what there is."
        )


def _written(
    reader: Reader, one: Yardstick, entries: Sequence[Entry], folder: Path
) -> Sequence[TextTable]:
    """Write the table of trials, the table of the page and the provenance; return what is shown."""
    trials = one.measure(reader, entries)
    table = one.tabulate(trials)
    outputs.write_table(trials, folder, f"{one.name}_trials")
    outputs.write_table(table, folder, one.name)
    facts = outputs.describe(reader, Selection(tuple(entries))) | {"name": one.name}
    outputs.write_provenance(facts, folder, one.name)
    return one.tables(table)


if __name__ == "__main__":
    run("studies.yardsticks.__main__")
