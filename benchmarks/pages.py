"""Response times of the results browser over twenty million rows.

The database is one of SQLite that is made for it, or the PostgreSQL one that ``DOPT_BENCH_DB``
names: that one is filled where it is empty, and kept.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager

from benchmarks.figures import fill
from benchmarks.processes import ROOT, database
from benchmarks.rows import Row, Target
from orchestrate.store import NoDatabaseError, Reader

SEEDS = 2_120
"""With 19 configurations of 500 steps, twenty million rows."""

LISTS = ("/", "/trials", "/trials?env=cartpole&sort=final_loss", "/api/grid")
CURVES = ("/api/curves?env=pendulum", "/api/curves?env=quadrotor")
LIST_SECONDS, CURVE_SECONDS = 1.0, 2.0
STEPS = "SELECT count(*) FROM step"


def measure(quick: bool) -> list[Row]:
    """Return seconds of the first visit of every page to a new server, the second in the note."""
    with tempfile.TemporaryDirectory() as folder:
        url = os.environ.get("DOPT_BENCH_DB") or database(folder)
        steps = _steps(url) or fill(url, 5 if quick else SEEDS)
        with _served(url) as address:
            return [
                _row(address, page, f"{steps:,} steps", Target(9, seconds))
                for pages, seconds in ((LISTS, LIST_SECONDS), (CURVES, CURVE_SECONDS))
                for page in pages
            ]


def _steps(url: str) -> int:
    """Return the number of steps that are stored, 0 where there is no database yet."""
    try:
        with Reader.open(url) as reader:
            return int(reader.rows(STEPS)[0][0])
    except NoDatabaseError:
        return 0


@contextmanager
def _served(url: str) -> Iterator[str]:
    """Serve a database in a process of its own, and yield the address."""
    words = ("-m", "analysis", "serve", "--db", url, "--port", "0")
    with subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, cwd=ROOT) as process:
        assert process.stdout is not None
        greeting = process.stdout.readline().decode()
        found = re.search(r"http://\S+(?=/)", greeting)
        try:
            if found is None:
                raise RuntimeError(f"The browser said '{greeting}', but its address is expected.")
            yield found.group()
        finally:
            process.terminate()


def _row(address: str, page: str, size: str, target: Target) -> Row:
    first, again = _seconds(address + page), _seconds(address + page)
    return Row(page, first, "s", target, note=f"{size}; again: {again:.3f} s")


def _seconds(address: str) -> float:
    start = time.perf_counter()
    with urllib.request.urlopen(address, timeout=300) as answer:
        answer.read()
    return time.perf_counter() - start
