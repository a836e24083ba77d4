"""Trials that are measured: all on the cartpole, as are the reference speeds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec

TINY_GRID, LARGE_GRID = (2, 2, 2), (20, 20, 20)

WINDOW = 100
"""Samples that the default learner sees; a step costs its full price once they are there."""


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
    """Return a trial in the cartpole; ``form`` is that of the information matrix."""
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


def settled(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    """Return the median over the steps in which the window is full, or over the last half."""
    return float(np.median(values[min(WINDOW, len(values) // 2) :]))


def step_us(result: TrialResult) -> float:
    """Return microseconds of planning and learning in a settled step."""
    return settled(result.plan_us + result.learn_us)


def run_in_turn(
    specs: dict[str, TrialSpec], rounds: int, run: Callable[[TrialSpec], TrialResult] = run_trial
) -> dict[str, list[TrialResult]]:
    """Return results of every trial by name, run A B A B with a new seed in each round.

    A first round with few steps loads the compiled code and is thrown away.
    """
    for spec in specs.values():
        run(_shortened(spec))
    results: dict[str, list[TrialResult]] = {name: [] for name in specs}
    for seed in range(rounds):
        for name, spec in specs.items():
            results[name].append(run(spec.with_seed(seed)))
    return results


def _shortened(spec: TrialSpec) -> TrialSpec:
    mapping = spec.to_mapping()
    env = mapping["env"]
    assert isinstance(env, dict)
    return TrialSpec.from_mapping({**mapping, "env": {**env, "horizon": 2}})


def median_of(results: list[TrialResult], measure: Callable[[TrialResult], float]) -> float:
    """Return the median over trials of what is measured in one."""
    return float(np.median([measure(result) for result in results]))
