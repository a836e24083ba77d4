"""Cost of a step on a black box beside the time that the black box itself takes."""

from __future__ import annotations

import importlib.util
import sys
import time
from statistics import median

from benchmarks.processes import ROOT
from benchmarks.rows import Row
from dopt.randomness import episode_seed
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems.black_box import BlackBox
from dopt.types import Array

ROUNDS = 5


def measure(quick: bool) -> list[Row]:
    """Return the cost of a step on the pendulum of Gymnasium, at q = 386, in whole trials."""
    if importlib.util.find_spec("gymnasium") is None:
        return [Row("black box", None, note="gymnasium is not installed")]
    folder = str(ROOT / "docs" / "example")
    sys.path.insert(0, folder)
    try:
        spec = TrialSpec.from_mapping(
            {
                "env": {"_target_": "swing.Swing"},
                "policy": {"name": "d_optimal"},
                "model": {"name": "mlp"},
                "learner": {"name": "adam_window"},
                "seed": 0,
            }
        )
    finally:
        sys.path.remove(folder)
    run_trial(spec)
    costs, alone = zip(
        *(_cost(spec.with_seed(i)) for i in range(1 if quick else ROUNDS)), strict=True
    )
    note = f"the environment's own step takes {1e6 * median(alone):.0f} µs"
    return [
        Row("D-optimal step beside a Gymnasium environment", 1e6 * median(costs), "µs", note=note)
    ]


def _cost(spec: TrialSpec) -> tuple[float, float]:
    """Return seconds a step beside the environment, and those of the environment."""
    start = time.perf_counter()
    result = run_trial(spec)
    whole = time.perf_counter() - start
    alone = _episode(spec, result.inputs)
    steps = len(result.inputs)
    return (whole - alone) / steps, alone / steps


def _episode(spec: TrialSpec, inputs: Array) -> float:
    """Return the seconds of an episode with given inputs."""
    assert isinstance(spec.system, BlackBox)
    start = time.perf_counter()
    episode = spec.system.episode(episode_seed(spec.seed))
    for u in inputs:
        episode.step(u)
    return time.perf_counter() - start
