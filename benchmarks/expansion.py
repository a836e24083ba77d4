"""Time to expand a grid and to recognise a finished one, as whole processes."""

from __future__ import annotations

import sqlite3
import tempfile
from pathlib import Path

from benchmarks import calibration
from benchmarks.processes import database, launch, run
from benchmarks.rows import Row, Target, Timing

PAPER = ("env=glob(*)", "policy=glob(*)", "seed=range(100)")
"""2,000 jobs, 100 of which make no sense and are left out."""

LARGE = (
    "env=glob(*)",
    "policy=d_optimal,random,uniform,baseline/random_sphere,baseline/random_held",
    "width=8,12,16,24,32",
    f"learner.learning_rate={','.join(f'{1 + i}e-3' for i in range(10))}",
    "seed=range(100)",
)
"""100,000 jobs over two choices of groups, two numbers and seeds."""

EXPANDED = "100,000 jobs expanded"


def measure(quick: bool) -> list[Row]:
    """Return seconds for 2,000 and 100,000 jobs, and for a finished grid of the larger size."""
    with tempfile.TemporaryDirectory() as folder:
        url = f"store.url={database(folder)}"
        dry = "launch.dry_run=true"
        runs = [launch("-m", *PAPER, dry, url) for _ in range(3)]
        seconds, cpu = min(one.seconds for one in runs), min(one.cpu_seconds for one in runs)
        timing = Timing(cpu, "s", calibration.seconds(calibration.interpreter))
        note = f"dry run, {cpu:.2f} s of CPU"
        small = Row("2,000 jobs expanded", seconds, "s", Target(4, 2), None, note, timing)
        if quick:
            return [small]
        large = launch("-m", *LARGE, dry, url)
        return [
            small,
            Row(EXPANDED, large.seconds, "s", Target(4, 10), note="dry run"),
            *_recognised(Path(folder), url),
        ]


def _recognised(folder: Path, url: str) -> list[Row]:
    """Write the large grid down, mark all of it as done, and launch it."""
    run("-m", "benchmarks.register", "-m", *LARGE, url)
    with sqlite3.connect(folder / "results.db") as connection:
        connection.execute("UPDATE trial SET status = 'done', n_steps = 500, final_loss = 1.0")
    connection.close()
    again = launch("-m", *LARGE, "executor=local", url)
    if "nothing to run" not in again.output:
        raise RuntimeError(f"the grid was not recognised as finished: {again.output[-500:]}")
    memory = again.peak_mebibytes
    return [
        Row("100,000 finished trials recognised", again.seconds, "s", Target(4, 10)),
        Row("driver with 100,000 trials", memory, "MiB", Target(4, 400), note="peak, resident"),
    ]
