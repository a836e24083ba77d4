"""Trials that are measured: all on the cartpole, as are the reference speeds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.rows import fixed_seconds
from dopt.kernel.linear_algebra import PENDING_ROWS
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.types import Vector

TINY_GRID, LARGE_GRID = (2, 2, 2), (20, 20, 20)

WINDOW = 100
"""Samples that the default learner sees; a step costs its full price once they are there."""

CYCLE = PENDING_ROWS // 2
"""Steps from one subtraction of the pending rows from M⁻¹ to the next, two rows a step."""


def cartpole(
    policy: str = "d_optimal",
    learner: str = "adam_window",
    seed: int = 0,
    *,
    width: int = 16,
    horizon: int = 500,
    grid: tuple[int, int, int] = (8, 16, 8),
    form: str = "auto",
) -> TrialSpec:
    """Return a trial in the cartpole; ``form``: form of the information matrix."""
    fields = {"form": form} if policy == "d_optimal" else {}
    return TrialSpec.from_mapping(
        {
            "env": {"name": "cartpole", "horizon": horizon, "grid_points": list(grid)},
            "policy": {"name": policy, **fields},
            "model": {"name": "mlp", "width": width},
            "learner": {"name": learner},
            "seed": seed,
        }
    )


class Cost(NamedTuple):
    """Time of a settled step in the quickest of several trials [µs].

    The minimum over trials leaves out what the machine did beside them; the mean and the 99th
    percentile over the steps of a trial leave out nothing: a step in eight is dear.
    """

    mean: float
    p99: float
    quickest: float
    """Mean of the quickest :data:`CYCLE` steps in a row: a section too short to be interrupted."""


def settled(values: Vector) -> Vector:
    """Return the steps in which the window is full, or the last half; a multiple of a cycle."""
    values = values[min(WINDOW, len(values) // 2) :]
    return values[len(values) % CYCLE :]


def cost(results: Sequence[TrialResult], measure: Callable[[TrialResult], Vector]) -> Cost:
    """Return the cost of what is measured in each step of some trials."""
    steps = [settled(measure(result)) for result in results]
    return Cost(
        min(float(one.mean()) for one in steps),
        min(float(np.percentile(one, 99)) for one in steps),
        min(float(one.reshape(-1, CYCLE).mean(axis=1).min()) for one in steps),
    )


def step_us(result: TrialResult) -> Vector:
    """Return microseconds of planning and learning in each step, (T,)."""
    return result.plan_us + result.learn_us


def run_in_turn(
    specs: dict[str, TrialSpec], rounds: int, run: Callable[[TrialSpec], TrialResult] = run_trial
) -> tuple[dict[str, list[TrialResult]], float]:
    """Return results of every trial by name, run A B A B with a new seed in each round.

    With them the quickest calibration between the trials [s]. A first round with few steps loads
    the compiled code and is thrown away.
    """
    for spec in specs.values():
        run(_shortened(spec))
    results: dict[str, list[TrialResult]] = {name: [] for name in specs}
    fixed = []
    for seed in range(rounds):
        for name, spec in specs.items():
            results[name].append(run(spec.with_seed(seed)))
            fixed.append(fixed_seconds())
    return results, min(fixed)


def _shortened(spec: TrialSpec) -> TrialSpec:
    mapping = spec.to_mapping()
    env = mapping["env"]
    assert isinstance(env, dict)
    return TrialSpec.from_mapping({**mapping, "env": {**env, "horizon": 2}})
