"""The variance of the accelerations that the filter over state and parameters fits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from dopt import run_trial
from dopt.algorithm import MOST_NOISE_FACTORS, NOISE_FACTORS
from dopt.reference.batch import Lockstep
from dopt.reference.joint_kalman import JointKalmanLearner
from tests.dopt.test_sensors import ANGLE, JOINTS, sensed

FITTED: dict[str, Any] = {"noise": "fitted", "refit_every": 7, "horizon": 22}
ONE_FIT = FITTED | {"refit_every": 60, "horizon": 60, "noise_variance": 30.0}


def in_lockstep(
    env: str, sensors: dict[str, Any], seeds: tuple[int, ...] = (0, 5), **fields: Any
) -> Lockstep:
    """Return a batch of trials after their last step, which ends with a fit."""
    specs = [sensed(env, sensors, seed=seed, path="reference", **fields) for seed in seeds]
    batch = Lockstep(specs)
    for t in range(specs[0].system.horizon):
        batch.step(t)
    return batch


def filter_of(batch: Lockstep) -> JointKalmanLearner:
    (found,) = (one for one in vars(batch).values() if isinstance(one, JointKalmanLearner))
    return found


@pytest.mark.parametrize(
    ("env", "sensors", "start"), [("pendulum", ANGLE, 1e2), ("arm", JOINTS, 1e4)]
)
def test_both_paths_fit_the_same(env: str, sensors: dict[str, Any], start: float) -> None:
    fields = FITTED | {"noise_variance": start}
    on_kernel = run_trial(sensed(env, sensors, **fields))
    batch = in_lockstep(env, sensors, **fields)
    np.testing.assert_allclose(on_kernel.parameters, batch.theta[0], rtol=1e-5, atol=1e-6)
    given = run_trial(sensed(env, sensors, **fields | {"noise": "given"}))
    assert np.abs(given.parameters - on_kernel.parameters).max() > 0.05


def test_it_is_the_likeliest_of_its_neighbours() -> None:
    learner = filter_of(in_lockstep("pendulum", ANGLE, **ONE_FIT))
    fitted, lowest = learner._noise.clone(), learner._run(ONE_FIT["horizon"])[0]
    moves = torch.log10(fitted / ONE_FIT["noise_variance"]).abs() / math.log10(NOISE_FACTORS[0])
    assert ((moves > 0.5) & (moves < MOST_NOISE_FACTORS - 0.5)).all()
    for factor in NOISE_FACTORS:
        learner._noise = factor * fitted
        assert (learner._run(ONE_FIT["horizon"])[0] >= lowest).all()


def test_trials_of_a_batch_have_their_own() -> None:
    both = filter_of(in_lockstep("pendulum", ANGLE, **ONE_FIT))._noise
    alone = filter_of(in_lockstep("pendulum", ANGLE, seeds=(5,), **ONE_FIT))._noise
    assert both[0] != pytest.approx(float(both[1]))
    torch.testing.assert_close(both[1:], alone)


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
