"""Overhead of the orchestration for a trial: trials of two steps through a whole launch."""

from __future__ import annotations

import tempfile

from benchmarks.launches import launch_trials
from benchmarks.processes import database
from benchmarks.rows import Row, Target
from benchmarks.trials import cartpole

WORKERS = 2


def measure(quick: bool) -> list[Row]:
    """Return milliseconds of a worker's time per trial that the trial itself did not take.

    From the first trial to the last, the workers' time less the trials' own is what handing out,
    bringing back and storing cost, or made the workers wait.
    """
    size = 300 if quick else 3_000
    specs = [cartpole(seed=seed, horizon=2) for seed in range(size)]
    with tempfile.TemporaryDirectory() as folder:
        found = launch_trials(database(folder), specs, WORKERS)
    beside = 1e3 * (WORKERS * found.span - found.work) / size
    note = f"{size / found.span:,.0f} trials/s, {1e3 * found.work / size:.2f} ms of own work each"
    return [Row("beside the trial's own work", beside, "ms/trial", Target(4, 2), note=note)]
