"""Time from the command to the first trial, once the kernel is compiled."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from datetime import datetime
from statistics import median

from benchmarks.processes import ROOT, database, launch
from benchmarks.rows import Row, Target
from orchestrate.store import Reader

TRIALS = ("env=cartpole", "policy=d_optimal", "env.horizon=10", "seed=0,1")


def measure(quick: bool) -> list[Row]:
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
        seconds = [_launch(executor, database(folder, name)) for name in names]
    return median(seconds[1:])


def _launch(executor: str, url: str) -> float:
    started = launch("-m", *TRIALS, f"executor={executor}", f"store.url={url}").started
    with Reader.open(url) as reader:
        first = reader.rows("SELECT min(started) FROM attempt")[0][0]
    return datetime.fromisoformat(first).timestamp() - started
