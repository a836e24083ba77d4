"""The variance of the accelerations that the filter over state and parameters fits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dopt import run_trial
from dopt.algorithm import MOST_NOISE_FACTORS, NOISE_FACTORS
from dopt.kernel.learners.joint_kalman import run_filter
from dopt.kernel.run import KernelTrial
from tests.dopt.kernel.calls import call
from tests.dopt.test_sensors import ANGLE, sensed

FITTED: dict[str, Any] = {"noise": "fitted", "refit_every": 7, "horizon": 22}
ONE_FIT: dict[str, Any] = {"noise": "fitted", "refit_every": 60, "horizon": 60}


def test_it_is_the_likeliest_of_its_neighbours() -> None:
    fast = KernelTrial(sensed("pendulum", ANGLE, **ONE_FIT, noise_variance=30.0))
    fast.advance(60)
    noise, none = fast.state.estimate.noise_variance, np.empty((0, len(fast.state.theta)))
    fitted, lowest = float(noise[0]), call(run_filter, fast.trial, 60, none, np.empty(0))
    moves = abs(math.log10(fitted / 30.0)) / math.log10(NOISE_FACTORS[0])
    assert 0.5 < moves < MOST_NOISE_FACTORS - 0.5
    for factor in NOISE_FACTORS:
        noise[0] = factor * fitted
        assert call(run_filter, fast.trial, 60, none, np.empty(0)) >= lowest


def test_it_forgets_where_it_began() -> None:
    """From ρ of 1e-3 and 1e3 alike: the angle better than measured, the loss below that of both."""
    errors, losses = {}, {}
    for noise in ("given", "fitted"):
        for start in (1e-3, 1e3):
            fields = {"noise": noise, "noise_variance": start, "refit_every": 25, "horizon": 200}
            result = run_trial(sensed("pendulum", ANGLE, **fields))
            assert result.estimated_states is not None
            gaps = (result.estimated_states - result.states)[100:, 0]
            errors[noise, start] = float(np.sqrt(np.mean(gaps**2)))
            losses[noise, start] = float(result.loss[-1])
    measured = ANGLE["measurement_noise"][0]
    assert max(errors["fitted", start] for start in (1e-3, 1e3)) < measured
    assert errors["given", 1e-3] > 2 * measured
    fitted = [losses["fitted", start] for start in (1e-3, 1e3)]
    assert max(fitted) < 1.5 * min(fitted)
    assert max(fitted) < 0.5 * min(losses["given", start] for start in (1e-3, 1e3))
