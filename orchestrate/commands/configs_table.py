"""Table of a grid: one row for each configuration, or for groups of them if there are too many."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from orchestrate.commands.display import table
from orchestrate.queries.config_columns import COLUMNS, column_text
from orchestrate.queries.status import counts
from orchestrate.store import ConfigRow

NAMES = ("env", "policy", "width")
DETAILS = tuple(name for name in COLUMNS if name not in NAMES)
_TEXT_COLUMNS = ("env", "policy", "model", "learner", "task", "limits")
_STYLES = {
    "failed": "red",
    "diverged": "yellow",
    "cancelled": "red",
    "running": "cyan",
    "pending": "dim",
}


def grid_table(configs: Sequence[ConfigRow], max_rows: int) -> Table:
    """Return a table of at most ``max_rows`` rows, or of one for each environment.

    Beside ``NAMES`` there is a column for each other one that tells configurations apart. Where
    that makes too many rows, columns go, from the last one on, and the configurations of a row
    are counted together.
    """
    columns = _columns(configs, max_rows)
    rows = _grouped(configs, columns)
    merged = len(rows) < len(configs)
    total = counts(configs)
    states = [state for state in _STYLES if state != "cancelled" or total[state]]
    heads = [*columns, *(["configs"] if merged else []), "done", "of", *states]
    footers = ["total", *[""] * (len(columns) - 1), *_numbers(configs, states, merged)]
    styles = [_STYLES.get(head, "") for head in heads]
    result = table(heads, numbers=set(heads) - {*_TEXT_COLUMNS}, styles=styles, footers=footers)
    for names, group in rows.items():
        result.add_row(*names, *_numbers(group, states, merged))
    return result


def _numbers(configs: Sequence[ConfigRow], states: Sequence[str], merged: bool) -> list[str]:
    number = counts(configs)
    words = [f"{number['done']:,}", f"{number.total():,}"]
    words += [f"{number[state]:,}" if number[state] else "-" for state in states]
    return [f"{len(configs):,}", *words] if merged else words


def _columns(configs: Sequence[ConfigRow], max_rows: int) -> list[str]:
    columns = list(NAMES)
    for detail in DETAILS:
        if len(_grouped(configs, [*columns, detail])) > len(_grouped(configs, columns)):
            columns.append(detail)
    while len(columns) > 1 and len(_grouped(configs, columns)) > max_rows:
        columns.pop()
    return columns


def _grouped(
    configs: Sequence[ConfigRow], columns: Sequence[str]
) -> dict[tuple[str, ...], list[ConfigRow]]:
    rows: dict[tuple[str, ...], list[ConfigRow]] = {}
    for config in configs:
        rows.setdefault(tuple(column_text(config, name) for name in columns), []).append(config)
    return rows
