"""Time of the grid of Figure 1: every system, every policy, 100 seeds, all stored."""

from __future__ import annotations

import tempfile

from benchmarks.processes import database, launch
from benchmarks.rows import Row, Target
from dopt.cores import usable_cores

SEEDS = 100


def measure(quick: bool) -> list[Row]:
    """Return minutes for 100 seeds on all cores, extended from two short grids."""
    few, more = (1, 2) if quick else (1, 6)
    with tempfile.TemporaryDirectory() as folder:
        short, long = (_seconds(folder, seeds) for seeds in (few, more))
    each = (long - short) / (more - few)
    minutes = (long + (SEEDS - more) * each) / 60
    cores = usable_cores()
    note = f"extended from {more} seeds at {each:.2f} s each, {cores} workers"
    return [Row("19 configurations × 100 seeds", minutes, "min", Target(3, 5), note=note)]


def _seconds(folder: str, seeds: int) -> float:
    grid = ("env=glob(*)", "policy=glob(*)", f"seed=range({seeds})", "executor=local")
    return launch("-m", *grid, f"store.url={database(folder, str(seeds))}").seconds
