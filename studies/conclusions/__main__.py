"""``python -m studies.conclusions``: run the trials of the study, and print its tables."""

from __future__ import annotations

import csv
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from orchestrate.program import Parser, answered, run, tell
from studies.conclusions.tables import ROWS, read, tables
from studies.conclusions.trials import Cell, Row, cells, row

SEEDS = (200, 300)
HELP = "which sentences of the paper hold, under which learner, on which plant"


@answered
def main(words: Sequence[str] | None = None) -> int:
    """Print the tables of the stored rows, after the trials that are missing if asked to; 0."""
    parser = Parser(prog="python -m studies.conclusions", description=HELP)
    parser.add_argument("--run", action="store_true", help="run the trials that are missing")
    parser.add_argument("--rows", type=Path, default=ROWS, help="file of the rows")
    options = parser.read(sys.argv[1:] if words is None else words)
    if options.run:
        complete(options.rows)
    tell(sys.stdout, tables(read(options.rows)))
    return 0


def complete(path: Path) -> None:
    """Run the trials without a row, and append their rows as they come."""
    done = {tuple(one[: len(Cell._fields) + 1]) for one in _lines(path)}
    wanted = [
        (cell, seed)
        for group in cells()
        for seed in range(*SEEDS)
        for cell in group
        if (*cell, str(seed)) not in done
    ]
    new = not path.exists()
    with path.open("a", newline="") as file, ProcessPoolExecutor(os.cpu_count()) as pool:
        writer = csv.writer(file, lineterminator="\n")
        if new:
            writer.writerow((*Cell._fields, "seed", *Row._fields))
        for (cell, seed), measured in zip(
            wanted, pool.map(row, *zip(*wanted, strict=True)), strict=True
        ):
            writer.writerow((*cell, seed, *(f"{value:.4g}" for value in measured)))
            file.flush()


def _lines(path: Path) -> Iterator[list[str]]:
    if path.exists():
        with path.open(newline="") as file:
            yield from csv.reader(file)


if __name__ == "__main__":
    run("studies.conclusions.__main__")
