"""Questions about reading: figures from two million rows, pages over twenty million.

The database of the pages is one of SQLite that is made for it, or the PostgreSQL one that
``DOPT_BENCH_DB`` names: that one is filled where it is empty, and kept.
"""

from __future__ import annotations

import dataclasses
import os
import re
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from benchmarks.processes import RECORD, ROOT, claims_for, database, run, run_record
from benchmarks.rows import Row, Target
from dopt.errors import IncompatibleError
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from orchestrate.store import NoDatabaseError, Reader, Store

SYSTEMS = ("pendulum", "cartpole", "arm", "quadrotor")
POLICIES = ("random", "uniform", "periodic", "d_optimal", "oracle")
"""Policies of the paper."""

FIGURE_SEEDS = 212
"""With 19 configurations of 500 steps, two million rows."""


def figures(quick: bool) -> list[Row]:
    """Return seconds of the whole command, all figures and tables."""
    seeds = 5 if quick else FIGURE_SEEDS
    with tempfile.TemporaryDirectory() as folder:
        url = database(folder)
        rows = fill(url, seeds)
        done = run("-m", "analysis", "figures", "--db", url, "--out", f"{folder}/figures")
    what = "all figures and tables"
    return [Row(what, done.seconds, "s", Target(5, 30), note=f"{rows:,} rows")]


def fill(url: str, seeds: int) -> int:
    """Store a trial of each configuration under many seeds, losses scaled; return the rows."""
    rows = 0
    with Store.open(url) as store:
        launch = store.begin_launch(RECORD)
        for spec in _specs():
            result = run_trial(spec)
            claims = claims_for(store, launch, [spec.with_seed(seed) for seed in range(seeds)])
            items = [(claim, _varied(result, i), run_record()) for i, claim in enumerate(claims)]
            rows += sum(store.commit_many(items)) * spec.system.horizon
        store.end_launch(launch, "done")
    return rows


def _specs() -> Iterator[TrialSpec]:
    for env in SYSTEMS:
        for policy in POLICIES:
            linear = policy == "oracle"
            learner = "recursive_least_squares" if linear else "adam_window"
            try:
                yield TrialSpec.from_mapping(
                    {
                        "env": {"name": env},
                        "policy": {"name": policy},
                        "model": {"name": "linear" if linear else "mlp"},
                        "learner": {"name": learner},
                    }
                )
            except IncompatibleError:
                continue


def _varied(result: TrialResult, seed: int) -> TrialResult:
    factor = float(np.exp(0.3 * np.random.default_rng(seed).standard_normal()))
    loss, reachable = factor * result.loss, factor * result.reachable_loss
    return dataclasses.replace(result, loss=loss, reachable_loss=reachable)


PAGE_SEEDS = 2_120
"""With 19 configurations of 500 steps, twenty million rows."""

LISTS = ("/", "/trials", "/trials?env=cartpole&sort=final_loss", "/api/grid")
CURVES = ("/api/curves?env=pendulum", "/api/curves?env=quadrotor")
LIST_SECONDS, CURVE_SECONDS = 1.0, 2.0
STEPS = "SELECT count(*) FROM step"


def pages(quick: bool) -> list[Row]:
    """Return seconds of the first visit of every page to a new server, the second in the note."""
    with tempfile.TemporaryDirectory() as folder:
        url = os.environ.get("DOPT_BENCH_DB") or database(folder)
        steps = _steps(url) or fill(url, 5 if quick else PAGE_SEEDS)
        with _served(url) as address:
            return [
                _row(address, page, f"{steps:,} steps", Target(9, seconds))
                for group, seconds in ((LISTS, LIST_SECONDS), (CURVES, CURVE_SECONDS))
                for page in group
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
