"""``python -m benchmarks.bit_equality OLD NEW``: exact comparison of two SQLite results databases.

Before a change, run a grid into one database; after it, run the same grid into another. Trial keys,
the losses of every step and the bytes of every trajectory have to be the same. Times are not
compared.
"""

from __future__ import annotations

import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

COMPARED = {
    "trial": "status, n_steps, final_loss, best_loss, diverged_at",
    "step": "t, loss, reachable_loss",
    "trajectory": "dtype, states_shape, states, inputs_shape, inputs, parameters_shape, parameters",
}
"""Columns of each table that have to be equal."""

USE = "run python -m benchmarks.bit_equality OLD NEW"

SHOWN = 10
"""Differences that are printed."""


def differences(old: Path, new: Path) -> Iterator[str]:
    """Yield a line for each trial that one database lacks and each table in which one differs."""
    with closing(_opened(old)) as before, closing(_opened(new)) as after:
        first, second = _trials(before), _trials(after)
        for key in first.keys() ^ second.keys():
            yield f"{_name(key)} is in {old if key in first else new} alone"
        for key in first.keys() & second.keys():
            for table, columns in COMPARED.items():
                if _rows(before, table, columns, first[key]) != _rows(
                    after, table, columns, second[key]
                ):
                    yield f"{_name(key)} differs in table {table}"


def _opened(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"file:{path}?mode=ro", uri=True)


def _trials(database: sqlite3.Connection) -> dict[str, int]:
    return dict(database.execute("SELECT trial_key, trial_id FROM trial"))


def _rows(database: sqlite3.Connection, table: str, columns: str, trial: int) -> list[object]:
    query = f"SELECT {columns} FROM {table} WHERE trial_id = ? ORDER BY 1"
    return database.execute(query, (trial,)).fetchall()


def _name(key: str) -> str:
    return f"trial {key[:12]}"


def main(arguments: list[str]) -> int:
    """Compare two databases; return 0 if they hold the same numbers, 1 if not, 2 for wrong use."""
    if len(arguments) != 2 or not all(Path(path).is_file() for path in arguments):
        sys.stdout.write(f"two SQLite databases are expected, but {arguments} was given: {USE}\n")
        return 2
    old, new = map(Path, arguments)
    found = list(differences(old, new))
    for line in found[:SHOWN]:
        sys.stdout.write(f"{line}\n")
    with closing(_opened(old)) as database:
        count = len(_trials(database))
    sys.stdout.write(f"{count:,} trials compared, {len(found):,} differences\n")
    return 1 if found or not count else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
