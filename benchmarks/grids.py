"""Questions about launches: start, expansion, storage, overhead, scaling, and the paper's grid."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.processes import (
    RECORD,
    ROOT,
    claims_for,
    database,
    launch,
    launch_trials,
    run_record,
)
from benchmarks.rows import Row, Target, Timing, fixed_seconds, interpreter
from benchmarks.trials import cartpole
from dopt.process import usable_cores
from dopt.run import run_trial
from orchestrate.store import Claim, Reader, Store

FIRST_TRIALS = ("env=cartpole", "policy=d_optimal", "env.horizon=10", "seed=0,1")


def startup(quick: bool) -> list[Row]:
    """Return seconds from the command to the first trial without and with Ray, and to import."""
    rounds = 1 if quick else 3
    rows = [
        Row(
            "import dopt", median(_import() for _ in range(rounds)), "s", note="issue: at most 1 s"
        ),
        Row("first trial, executor=local", _first("local", rounds), "s", Target(7, 3)),
    ]
    if not quick:
        rows.append(Row("first trial, executor=ray", _first("ray", 2), "s", Target(7, 10)))
    return rows


def _import() -> float:
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import dopt.run"], cwd=ROOT, check=True)
    return time.perf_counter() - start


def _first(executor: str, rounds: int) -> float:
    """Return the median over launches; one before them brings files into memory."""
    with tempfile.TemporaryDirectory() as folder:
        names = [str(i) for i in range(1 + rounds)]
        seconds = [_until_first(executor, database(folder, name)) for name in names]
    return median(seconds[1:])


def _until_first(executor: str, url: str) -> float:
    started = launch("-m", *FIRST_TRIALS, f"executor={executor}", f"store.url={url}").started
    with Reader.open(url) as reader:
        first = reader.rows("SELECT min(started) FROM attempt")[0][0]
    return datetime.fromisoformat(first).timestamp() - started


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


def expansion(quick: bool) -> list[Row]:
    """Return seconds for 2,000 and 100,000 jobs, and for a finished grid of the larger size."""
    with tempfile.TemporaryDirectory() as folder:
        url = f"store.url={database(folder)}"
        dry = "launch.dry_run=true"
        runs, fixed = [], [fixed_seconds(interpreter)]
        for _ in range(3):
            runs.append(launch("-m", *PAPER, dry, url))
            fixed.append(fixed_seconds(interpreter))
        seconds, cpu = min(one.seconds for one in runs), min(one.cpu_seconds for one in runs)
        timing = Timing(cpu, "s", min(fixed))
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
    launch("-m", *LARGE, "launch.detach=true", url)
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


STORE_ROUNDS = 4


def store(quick: bool) -> list[Row]:
    """Return rows per second with a transaction for each trial and with one for twenty."""
    result, steps = run_trial(cartpole()), cartpole().system.horizon
    run, size = run_record(), 20 if quick else 60
    with tempfile.TemporaryDirectory() as folder, Store.open(database(folder)) as opened:
        launch = opened.begin_launch(RECORD)
        claims = claims_for(
            opened, launch, [cartpole(seed=s) for s in range(2 * size * STORE_ROUNDS)]
        )

        def one_by_one(part: Sequence[Claim]) -> None:
            for claim in part:
                opened.commit(claim, result, run)

        def together(part: Sequence[Claim]) -> None:
            for start in range(0, len(part), 20):
                opened.commit_many([(claim, result, run) for claim in part[start : start + 20]])

        parts = [claims[i : i + size] for i in range(0, len(claims), size)]
        pairs = zip(parts[::2], parts[1::2], strict=True)
        seconds = np.array([[_time(one_by_one, a), _time(together, b)] for a, b in pairs])
        opened.end_launch(launch, "done")
    alone, many = (size * steps / np.median(seconds, axis=0)).tolist()
    target = Target(4, 300_000, at_least=True)
    return [
        Row("step rows into SQLite, commit", alone, "rows/s", target, note="durable per trial"),
        Row("step rows into SQLite, commit_many of 20", many, "rows/s", target),
    ]


def _time(function: Callable[[Sequence[Claim]], None], part: Sequence[Claim]) -> float:
    start = time.perf_counter()
    function(part)
    return time.perf_counter() - start


WORKERS = 2


def orchestration(quick: bool) -> list[Row]:
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


SCALING_ROUNDS = 2


def scaling(quick: bool) -> list[Row]:
    """Return how many times as fast two local workers are as one, all with loaded code."""
    if usable_cores() < 2:
        return [Row("two workers in speeds of one", None, note="this machine has one core")]
    specs = [cartpole(seed=seed) for seed in range(24 if quick else 80)]
    ratios, rates = [], []
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(1 if quick else SCALING_ROUNDS):
            one, two = (
                launch_trials(database(folder, f"{turn}-{workers}"), specs, workers).rate
                for workers in (1, 2)
            )
            ratios.append(two / one)
            rates.append(two)
    note = f"{median(rates):.1f} trials/s with two"
    target = Target(8, 1.8, at_least=True)
    return [Row("two workers in speeds of one", median(ratios), "×", target, note=note)]


PAPER_SEEDS = 100


def paper(quick: bool) -> list[Row]:
    """Return minutes for 100 seeds on all cores, extended from two short grids."""
    few, more = (1, 2) if quick else (1, 6)
    with tempfile.TemporaryDirectory() as folder:
        short, long = (_grid_seconds(folder, seeds) for seeds in (few, more))
    each = (long - short) / (more - few)
    minutes = (long + (PAPER_SEEDS - more) * each) / 60
    cores = usable_cores()
    note = f"extended from {more} seeds at {each:.2f} s each, {cores} workers"
    return [Row("19 configurations × 100 seeds", minutes, "min", Target(3, 5), note=note)]


def _grid_seconds(folder: str, seeds: int) -> float:
    grid = ("env=glob(*)", "policy=glob(*)", f"seed=range({seeds})", "executor=local")
    return launch("-m", *grid, f"store.url={database(folder, str(seeds))}").seconds
