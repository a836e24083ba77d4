"""A watched trial tells its losses and computes the same numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dopt import run_trial
from dopt.kernel.run import FIRST_STEPS
from dopt.result import TrialResult
from dopt.run import Path
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from dopt.watching import current_watch, watched
from tests.dopt.trials import trial

TIMES = ("plan_us", "learn_us", "evaluate_us", "wall_seconds", "cpu_seconds")

Told = list[tuple[int, Array, Array]]


def watch(spec: TrialSpec, seconds: float, path: Path | None = None) -> tuple[TrialResult, Told]:
    told: Told = []

    def tell(*sample: Any) -> None:
        told.append(sample)

    with watched(seconds, tell):
        result = run_trial(spec, path)
    assert current_watch() is None
    return result, told


def numbers(result: TrialResult) -> dict[str, Any]:
    return {name: value for name, value in vars(result).items() if name not in TIMES}


@pytest.mark.parametrize("path", ["kernel", "reference"])
@pytest.mark.parametrize("policy", ["random", "d_optimal"])
def test_it_has_the_same_bits(policy: str, path: Path) -> None:
    horizon = 3 * FIRST_STEPS if path == "kernel" else 40
    spec = trial("pendulum", policy, env={"horizon": horizon})
    result, told = watch(spec, 1e-9, path)
    np.testing.assert_equal(numbers(result), numbers(run_trial(spec, path)))
    assert len(told) > 10
    steps = [t for t, _, _ in told]
    assert steps == sorted(set(steps))
    for t, loss, reachable in told:
        assert (loss.tolist(), reachable.tolist()) == (
            [result.loss[t]],
            [result.reachable_loss[t]],
        )


def test_a_sample_comes_about_as_often_as_asked() -> None:
    spec = trial("pendulum", "random", env={"horizon": 20_000})
    result, told = watch(spec, 0.1)
    assert 1 <= len(told) <= result.wall_seconds / 0.1
    assert watch(spec, 3600.0)[1] == []


def test_a_trial_that_diverges_tells_what_is_finite() -> None:
    spec = trial("pendulum", "random", env={"horizon": 200, "state_limit": 1.0, "gamma": 30.0})
    result, told = watch(spec, 1e-9)
    assert result.diverged_at is not None
    assert all(np.isfinite(loss) and t < result.diverged_at for t, loss, _ in told)
