"""Scaling: throughput of two workers against one, on whole D-optimal trials in turn."""

from __future__ import annotations

import tempfile
from statistics import median

from benchmarks.launches import launch_trials
from benchmarks.processes import database
from benchmarks.rows import Row, Target
from benchmarks.trials import cartpole
from dopt.cores import usable_cores

ROUNDS = 2


def measure(quick: bool) -> list[Row]:
    """Return the speed of two local workers in that of one, once all have loaded their code."""
    if usable_cores() < 2:
        return [Row("two workers in speeds of one", None, note="this machine has one core")]
    specs = [cartpole(seed=seed) for seed in range(24 if quick else 80)]
    ratios, rates = [], []
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(1 if quick else ROUNDS):
            one, two = (
                launch_trials(database(folder, f"{turn}-{workers}"), specs, workers).rate
                for workers in (1, 2)
            )
            ratios.append(two / one)
            rates.append(two)
    note = f"{median(rates):.1f} trials/s with two"
    target = Target(8, 1.8, at_least=True)
    return [Row("two workers in speeds of one", median(ratios), "×", target, note=note)]
