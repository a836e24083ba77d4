"""The loss that the kernel reports, in single precision and, where that is not enough, double."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dopt.evaluation import evaluation_set
from dopt.kernel.run import KernelTrial
from dopt.spec.trial import TrialSpec
from tests.dopt.torch_models import model_of_one
from tests.dopt.trials import PAIRS, trial


def losses(spec: TrialSpec, theta: np.ndarray, step: int = 0) -> tuple[float, float]:
    """Return the L2 errors over the grid and over the reachable states, point by point."""
    points, model = evaluation_set(spec.system), model_of_one(spec.system, spec.model)
    found = np.stack([model(torch.tensor(theta), x).numpy() for x in torch.tensor(points.states)])
    squares = ((found - spec.system.learned(points.states, step)) ** 2).sum(axis=1)
    means = squares[: points.n_grid].mean(), squares[points.n_grid :].mean()
    return float(np.sqrt(means[0])), float(np.sqrt(means[1]))


@pytest.mark.parametrize(("env", "policy"), [p for p in PAIRS if p[1] in ("random", "oracle")])
def test_the_loss_is_the_root_mean_square_over_the_points(env: str, policy: str) -> None:
    spec = trial(env, policy, 1, env={"horizon": 3})
    fast = KernelTrial(spec)
    fast.advance(3)
    grid, reachable = losses(spec, fast.state.theta, 2)
    assert fast.record.loss[2] == pytest.approx(grid, rel=1e-5)
    assert fast.record.reachable_loss[2] == pytest.approx(reachable, rel=1e-5)


@pytest.mark.parametrize(("bend", "precision"), [(0.5, 1e-5), (0.1, 1e-8), (1e-3, 1e-6)])
def test_a_small_loss_is_not_lost_in_rounding(bend: float, precision: float) -> None:
    """One tanh of a small argument nearly is the friction of a pendulum without gravity."""
    spec = trial(
        "pendulum",
        "random",
        env={"horizon": 1, "gravity": 0.0, "grid_points": [16, 16]},
        model={"depth": 1, "width": 1},
        learner={"learning_rate": 1e-300},
    )
    pendulum, fast = spec.system, KernelTrial(spec)
    width = pendulum.grid_half_widths[1]
    slope = -3.0 * pendulum.friction / (pendulum.mass * pendulum.length**2)  # type: ignore[attr-defined]
    fast.state.theta[:] = [0.0, 0.0, bend, 0.0, slope * width / bend, 0.0]
    fast.advance(1)
    grid, reachable = losses(spec, fast.state.theta)
    assert grid < bend**2 * abs(slope) * width
    assert fast.record.loss[0] == pytest.approx(grid, rel=precision)
    assert fast.record.reachable_loss[0] == pytest.approx(reachable, rel=precision)


@pytest.mark.parametrize("points", [[1, 1], [15, 17], [16, 16], [257, 1], [40, 20]])
def test_any_number_of_points_is_evaluated(points: list[int]) -> None:
    spec = trial("pendulum", "random", env={"horizon": 1, "grid_points": points})
    fast = KernelTrial(spec)
    fast.advance(1)
    grid, reachable = losses(spec, fast.state.theta)
    assert fast.record.loss[0] == pytest.approx(grid, rel=1e-5)
    assert fast.record.reachable_loss[0] == pytest.approx(reachable, rel=1e-5)


def test_steps_that_are_done_are_not_done_again() -> None:
    spec = trial("pendulum", "d_optimal", 1)
    straight, back = KernelTrial(spec), KernelTrial(spec)
    straight.advance(20)
    for last in (10, 5, 10, 20):
        back.advance(last)
    np.testing.assert_array_equal(back.parameters, straight.parameters)
    assert np.isnan(back.states[21:]).all()
