"""Time of a whole trial that is evaluated in every step."""

from __future__ import annotations

import time

import numpy as np

from benchmarks import anchors
from benchmarks.rows import Anchor, Row, Target
from benchmarks.trials import LARGE_GRID, cartpole
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec

TIMES_FASTER = 40


def measure(quick: bool) -> list[Row]:
    """Return seconds of a D-optimal trial of 500 steps, beside those of the authors' code.

    For the default grid the anchor is 500 steps without any evaluation, which favours the authors'
    code: how long it takes for so few points is not known.
    """
    specs = {"default": cartpole(), "large": cartpole(grid=LARGE_GRID)}
    rounds = 2 if quick else 6
    seconds: dict[str, list[float]] = {name: [] for name in specs}
    for seed in range(-1, rounds):
        for name, spec in specs.items():
            taken = _seconds(spec.with_seed(max(seed, 0)))
            if seed >= 0:
                seconds[name].append(taken)
    step, evaluation = anchors.STEP.value, anchors.EVALUATION.value
    microseconds = {"default": step, "large": step + evaluation}
    rows = []
    for name, what in (("default", "default grid"), ("large", "8,000 points")):
        steps = specs[name].system.horizon
        anchor = Anchor(1e-6 * steps * microseconds[name], anchors.STEP.source)
        target = Target(2, anchor.value / TIMES_FASTER) if name == "default" else None
        rows.append(Row(what, float(np.median(seconds[name])), "s", target, anchor))
    return rows


def _seconds(spec: TrialSpec) -> float:
    start = time.perf_counter()
    run_trial(spec)
    return time.perf_counter() - start
