"""Mean and longest step of the configurations among which the README lets its reader choose.

``python -m studies.speed.step_times > docs/step_times.csv`` writes what the pages print.
"""

from __future__ import annotations

import csv
import sys
from typing import Any

import numpy as np

from benchmarks.trials import WINDOW, step_us
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec

SYSTEMS = ("pendulum", "cartpole", "arm", "quadrotor")
SEEDS = range(1000, 1005)

_EPISODIC = {"name": "episodic", "domain": "box", "replan_every": 10}
CONFIGURATIONS: dict[str, dict[str, Any]] = {
    "D-optimal, adam_window": {"policy": "d_optimal", "learner": "adam_window"},
    "episodic plans, domain=box, replan_every=10, adam_replay": {
        "policy": _EPISODIC,
        "learner": "adam_replay",
    },
    "episodic plans, domain=box, replan_every=10, gauss_newton": {
        "policy": _EPISODIC,
        "learner": "gauss_newton",
    },
    "iCEM, domain=box, gauss_newton, ensemble": {
        "policy": {"name": "icem", "domain": "box"},
        "learner": "gauss_newton",
        "model": "ensemble",
    },
}


def times(name: str, env: str, seed: int) -> tuple[float, float, float]:
    """Return mean, 99th percentile and maximum of the settled steps of a trial [µs]."""
    parts = {"model": "mlp", **CONFIGURATIONS[name]}
    spec = TrialSpec.from_names(env=env, seed=seed, **parts)
    steps = step_us(run_trial(spec))[WINDOW:]
    return float(steps.mean()), float(np.percentile(steps, 99)), float(steps.max())


if __name__ == "__main__":
    table = csv.writer(sys.stdout, lineterminator="\n")
    table.writerow(["configuration", "env", "seed", "mean_us", "p99_us", "longest_us"])
    for one in CONFIGURATIONS:
        for system in SYSTEMS:
            for trial in SEEDS:
                numbers = (f"{value:.1f}" for value in times(one, system, trial))
                table.writerow([one, system, trial, *numbers])
