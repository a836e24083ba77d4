"""The grid as a table: one row for each configuration, fewer where there are too many."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from orchestrate.commands.display import table
from orchestrate.status import counts
from orchestrate.store import Cell

NAMES = ("env", "policy", "width")
DETAILS = ("depth", "model", "learner", "horizon", "dt", "gamma")
_WORDS = ("env", "policy", "model", "learner")
_STYLES = {
    "failed": "red",
    "diverged": "yellow",
    "cancelled": "red",
    "running": "cyan",
    "pending": "dim",
}


def grid_table(cells: Sequence[Cell], most: int) -> Table:
    """Return a table of at most ``most`` rows, or of one for each environment.

    Beside ``NAMES`` there is a column for each other one that tells configurations apart. Where
    that makes too many rows, columns go, from the last one on, and the configurations of a row
    are counted together.
    """
    columns = _columns(cells, most)
    rows = _grouped(cells, columns)
    merged = len(rows) < len(cells)
    total = counts(cells)
    states = [state for state in _STYLES if state != "cancelled" or total[state]]
    heads = [*columns, *(["configs"] if merged else []), "done", "of", *states]
    footers = ["total", *[""] * (len(columns) - 1), *_numbers(cells, states, merged)]
    styles = [_STYLES.get(head, "") for head in heads]
    result = table(heads, numbers=set(heads) - {*_WORDS}, styles=styles, footers=footers)
    for names, group in rows.items():
        result.add_row(*names, *_numbers(group, states, merged))
    return result


def _numbers(cells: Sequence[Cell], states: Sequence[str], merged: bool) -> list[str]:
    number = counts(cells)
    words = [f"{number['done']:,}", f"{number.total():,}"]
    words += [f"{number[state]:,}" if number[state] else "-" for state in states]
    return [f"{len(cells):,}", *words] if merged else words


def _columns(cells: Sequence[Cell], most: int) -> list[str]:
    columns = list(NAMES)
    for detail in DETAILS:
        if len(_grouped(cells, [*columns, detail])) > len(_grouped(cells, columns)):
            columns.append(detail)
    while len(columns) > 1 and len(_grouped(cells, columns)) > most:
        columns.pop()
    return columns


def _grouped(cells: Sequence[Cell], columns: Sequence[str]) -> dict[tuple[str, ...], list[Cell]]:
    rows: dict[tuple[str, ...], list[Cell]] = {}
    for cell in cells:
        rows.setdefault(tuple(_text(getattr(cell, name)) for name in columns), []).append(cell)
    return rows


def _text(value: object) -> str:
    return "-" if value is None else str(value)
