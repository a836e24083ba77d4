"""Time of all figures from two million rows: real trials, each stored many times."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator

import numpy as np

from benchmarks.launches import RECORD, claims_for, run_record
from benchmarks.processes import database, run
from benchmarks.rows import Row, Target
from dopt.errors import IncompatibleError
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from orchestrate.store import Store

SYSTEMS = ("pendulum", "cartpole", "arm", "quadrotor")
POLICIES = ("random", "uniform", "periodic", "d_optimal", "oracle")
"""Those of the paper."""

SEEDS = 212
"""With 19 configurations of 500 steps, two million rows."""


def measure(quick: bool) -> list[Row]:
    """Return seconds of the whole command, all figures and tables."""
    seeds = 5 if quick else SEEDS
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
