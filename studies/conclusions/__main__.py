"""``python -m studies.conclusions``: run the trials of the study, and print its tables."""

from __future__ import annotations

import csv
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from orchestrate.program import Parser, answered, run, tell
from studies.conclusions import filter as joint_filter
from studies.conclusions import network, tables, trials

HELP = "which sentences of the paper hold, under which learner, on which plant"


class Part(NamedTuple):
    """A part of the study: the file of its rows, its trials, and what is kept of one."""

    rows: Path
    seeds: tuple[int, int]
    cells: Callable[[], list[list[Any]]]
    row: Callable[[Any, int], Any]
    names: tuple[str, ...]
    tables: Callable[[Path], str]


PARTS = {
    "sentences": Part(
        tables.ROWS,
        (200, 300),
        trials.cells,
        trials.row,
        (*trials.Cell._fields, "seed", *trials.Row._fields),
        lambda path: tables.tables(tables.read(path)),
    ),
    "network": Part(
        tables.NETWORK,
        network.SEEDS,
        network.cells,
        network.row,
        (*network.Cell._fields, "seed", *network.Row._fields),
        tables.conclusions_network,
    ),
    "filter": Part(
        tables.FILTER,
        joint_filter.SEEDS,
        joint_filter.cells,
        joint_filter.row,
        (*joint_filter.Cell._fields, "seed", *joint_filter.Row._fields),
        lambda path: f"{tables.filter_intervals(path)}\n{tables.filter_noise(path)}",
    ),
}


@answered
def main(words: Sequence[str] | None = None) -> int:
    """Print the tables of the stored rows, after the trials that are missing if asked to; 0."""
    parser = Parser(prog="python -m studies.conclusions", description=HELP)
    parser.add_argument(
        "part", nargs="?", default="sentences", choices=PARTS, help="part of the study"
    )
    parser.add_argument("--run", action="store_true", help="run the trials that are missing")
    parser.add_argument("--rows", type=Path, help="file of the rows")
    options = parser.read(sys.argv[1:] if words is None else words)
    part = PARTS[options.part]
    path = options.rows or part.rows
    if options.run:
        complete(path, part)
    tell(sys.stdout, part.tables(path))
    return 0


def complete(path: Path, part: Part) -> None:
    """Run the trials without a row, and append their rows as they come."""
    n_keys = part.names.index("seed") + 1
    done = {tuple(one[:n_keys]) for one in _lines(path)}
    wanted = [
        (cell, seed)
        for group in part.cells()
        for seed in range(*part.seeds)
        for cell in group
        if (*map(str, cell), str(seed)) not in done
    ]
    new = not path.exists()
    with path.open("a", newline="") as file, ProcessPoolExecutor(os.cpu_count()) as pool:
        writer = csv.writer(file, lineterminator="\n")
        if new:
            writer.writerow(part.names)
        found = pool.map(part.row, [cell for cell, _ in wanted], [seed for _, seed in wanted])
        for (cell, seed), measured in zip(wanted, found, strict=True):
            writer.writerow((*cell, seed, *(f"{value:.4g}" for value in measured)))
            file.flush()


def _lines(path: Path) -> Iterator[list[str]]:
    if path.exists():
        with path.open(newline="") as file:
            yield from csv.reader(file)


if __name__ == "__main__":
    run("studies.conclusions.__main__")
