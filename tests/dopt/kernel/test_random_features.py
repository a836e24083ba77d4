"""Random Fourier features in the compiled kernel: against their definition."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dopt.assessment import model_forecast
from dopt.kernel.from_spec import points_of_trial, shared_points
from dopt.kernel.linear_algebra import dense
from dopt.kernel.run import KernelTrial
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from tests.close import assert_close
from tests.dopt.kernel.calls import model_of_kernel
from tests.dopt.kernel.twin import relative_gap
from tests.dopt.trials import trial

FEATURES = {"name": "rff", "n_features": 30}


def features(env: str, policy: str = "d_optimal", /, **fields: Any) -> TrialSpec:
    """Return a small trial that learns random features."""
    sections: dict[str, Any] = {
        "model": FEATURES,
        "learner": {"name": "recursive_least_squares"},
        "env": {"horizon": 9},
    }
    merged = {key: sections.get(key, {}) | entries for key, entries in fields.items()}
    return trial(env, policy, 3, **(sections | merged))


@pytest.mark.parametrize("policy", ["d_optimal", "random_held"])
def test_the_inverse_information_is_that_of_all_rows_of_the_learned_parameters(policy: str) -> None:
    """With the ridge of a policy that plans by it, or that of the learner."""
    ridges = {"learner": {"regularization": 3e-2}}
    if policy == "d_optimal":
        ridges["policy"] = {"regularization": 1e-2}
    fast = KernelTrial(features("arm", policy, env={"horizon": 37}, **ridges))
    fast.advance(37)
    spec, drawn = fast.spec, fast.parameters[60:]
    units = np.concatenate([np.eye(60), np.tile(drawn, (60, 1))], axis=1)
    states = fast.states[:-1]
    columns = [spec.model.predict(spec.system, unit, states).ravel() for unit in units]
    J = np.stack(columns, axis=1)
    M = (1e-2 if policy == "d_optimal" else 3e-2) * np.eye(60) + J.T @ J
    assert_close(dense(fast.state.covariance) @ M, np.eye(60), abs=1e-8)


@pytest.mark.parametrize("env", ["pendulum", "arm", "quadrotor"])
def test_change_of_the_rows_is_that_of_finite_differences(env: str) -> None:
    spec, rng, h = features(env), np.random.default_rng(0), 1e-5
    model = model_of_kernel(spec)
    for _ in range(5):
        x, direction = rng.normal(size=(2, spec.system.n_states))
        ahead, behind = model.jacobian(x + h * direction), model.jacobian(x - h * direction)
        change = model.jacobian_change(x, direction[None])[0]
        for k, expected in enumerate((ahead - behind) / (2.0 * h)):
            assert relative_gap(change[k], expected) < 1e-8


def test_stored_parameters_give_the_last_loss_and_keep_what_was_drawn() -> None:
    spec = features("arm")
    result, before = run_trial(spec), KernelTrial(spec).parameters
    grid = spec.system.grid()
    errors = spec.model.predict(spec.system, result.parameters, grid) - spec.system.learned(grid)
    assert np.sqrt((errors**2).sum(axis=1).mean()) == pytest.approx(result.final_loss, rel=1e-9)
    assert np.array_equal(result.parameters[60:], before[60:])
    assert np.all(result.parameters[:60] != 0.0)
    other = KernelTrial(spec.with_seed(4)).parameters
    assert np.all(other[60:] != before[60:])


def test_an_assessment_predicts_with_all_parameters() -> None:
    spec = features("arm", env={"horizon": 20})
    parameters = run_trial(spec).parameters
    rng = np.random.default_rng(1)
    states = rng.normal(size=(5, spec.system.n_states))
    inputs = rng.normal(size=(5, 2, spec.system.n_inputs))
    following = model_forecast(spec.system, spec.model, parameters)(states, inputs)[0]
    flow = np.stack(
        [*spec.system.known(tuple(states.T), tuple(inputs[:, 0].T), spec.system.parameters)]
    )
    flow[list(spec.system.learned_rows)] += spec.model.predict(spec.system, parameters, states).T
    assert following == pytest.approx(states + spec.system.dt * flow.T, rel=1e-12)


def test_memory_counts_the_features_at_the_evaluation_points() -> None:
    spec = features("pendulum", env={"grid_points": [64, 64]}, model={"n_features": 200})
    points = points_of_trial(shared_points(spec.config), KernelTrial(spec).trial.network, 9)
    q = 200
    assert spec.config.memory >= points.basis.nbytes + 8 * q**2
    assert spec.config.largest_setting == "model.n_features"
