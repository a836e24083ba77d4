"""Time of a whole trial that is evaluated in every step."""

from __future__ import annotations

import time

from benchmarks import anchors, calibration
from benchmarks.rows import Anchor, Row, Target, Timing
from benchmarks.trials import LARGE_GRID, cartpole
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec

TARGET_SECONDS = 0.158
"""A fortieth of what the authors' code took for 500 steps when the target was set."""


def measure(quick: bool) -> list[Row]:
    """Return seconds of a D-optimal trial of 500 steps, beside those of the authors' code.

    For the default grid the anchor is 500 steps without any evaluation, which favours the authors'
    code: how long it takes for so few points is not known.
    """
    specs = {"default": cartpole(), "large": cartpole(grid=LARGE_GRID)}
    rounds = 4 if quick else 6
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in specs}
    fixed = []
    for seed in range(-1, rounds):
        for name, spec in specs.items():
            taken[name].append(_seconds(spec.with_seed(max(seed, 0))))
        fixed.append(calibration.seconds())
    step, evaluation = anchors.STEP.value, anchors.EVALUATION.value
    microseconds = {"default": step, "large": step + evaluation}
    rows = []
    for name, what in (("default", "default grid"), ("large", "8,000 points")):
        steps = specs[name].system.horizon
        anchor = Anchor(1e-6 * steps * microseconds[name], anchors.STEP.source)
        target = Target(2, TARGET_SECONDS) if name == "default" else None
        wall, cpu = map(min, zip(*taken[name][1:], strict=True))
        timing = Timing(cpu, "s", min(fixed))
        rows.append(Row(what, wall, "s", target, anchor, f"{cpu:.4f} s of CPU", timing))
    return rows


def _seconds(spec: TrialSpec) -> tuple[float, float]:
    """Return the seconds of a trial, and those of the processor."""
    wall, cpu = time.perf_counter(), time.process_time()
    run_trial(spec)
    return time.perf_counter() - wall, time.process_time() - cpu
