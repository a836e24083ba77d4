"""Rows of steps that the results database takes a second, committed trial by trial."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.launches import RECORD, claims_for, run_record
from benchmarks.processes import database
from benchmarks.rows import Row, Target
from benchmarks.trials import cartpole
from dopt.run import run_trial
from orchestrate.store import Claim, Store

ROUNDS = 4


def measure(quick: bool) -> list[Row]:
    """Return rows per second with a transaction for each trial and with one for twenty."""
    result, steps = run_trial(cartpole()), cartpole().system.horizon
    run, size = run_record(), 20 if quick else 60
    with tempfile.TemporaryDirectory() as folder, Store.open(database(folder)) as store:
        launch = store.begin_launch(RECORD)
        claims = claims_for(store, launch, [cartpole(seed=s) for s in range(2 * size * ROUNDS)])

        def one_by_one(part: Sequence[Claim]) -> None:
            for claim in part:
                store.commit(claim, result, run)

        def together(part: Sequence[Claim]) -> None:
            for start in range(0, len(part), 20):
                store.commit_many([(claim, result, run) for claim in part[start : start + 20]])

        parts = [claims[i : i + size] for i in range(0, len(claims), size)]
        pairs = zip(parts[::2], parts[1::2], strict=True)
        seconds = np.array([[_time(one_by_one, a), _time(together, b)] for a, b in pairs])
        store.end_launch(launch, "done")
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
