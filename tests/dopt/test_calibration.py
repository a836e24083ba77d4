"""Fit and calibration at held-out states: Jacobians, known posteriors, what has none."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from dopt.evaluation import evaluation_set
from dopt.offline_fit import (
    HeldOut,
    Samples,
    held_out_fit,
    jacobian,
    predicted_variances,
    recorded_samples,
)
from dopt.reference.models import mlp_function
from dopt.run import run_trial
from dopt.spec.compatibility import Information
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import trial

LINEAR: dict[str, Any] = {
    "model": {"name": "linear"},
    "learner": {"name": "ekf", "regularization": 1e-6},
}


def fits(spec: TrialSpec) -> HeldOut:
    result = run_trial(spec)
    return held_out_fit(spec, result.parameters, result.states, result.inputs)


def evaluated(spec: TrialSpec) -> Samples:
    points = evaluation_set(spec.system)
    return Samples(points.states, points.inputs, points.accelerations)


def test_the_posterior_of_a_linear_model_covers_the_truth_as_often_as_it_says() -> None:
    """Over trials, whose noise differs, 90 % of the intervals hold; so they do with more noise."""
    for noise in (1e-3, 1e-2):
        covered = [
            fits(trial("pendulum", "random", seed, env={"noise": noise}, **LINEAR)).grid.covered
            for seed in range(40)
        ]
        # Two parameters are unknown, so the errors of a trial go together: standard error 0.035.
        assert np.mean(covered) == pytest.approx(0.9, abs=0.1)


def test_the_log_loss_of_a_linear_model_is_lowest_with_the_covariance_of_the_noise() -> None:
    """Trials that are judged by another noise than they had are judged too narrow or too wide."""
    seeds, found = range(20), {}
    for factor in (0.2, 1.0, 5.0):
        values = []
        for seed in seeds:
            spec = trial("pendulum", "random", seed, **LINEAR)
            result = run_trial(spec)
            other = dataclasses.replace(spec.system, noise=factor * spec.system.noise)
            judged = dataclasses.replace(
                spec, config=dataclasses.replace(spec.config, system=other)
            )
            fit = held_out_fit(judged, result.parameters, result.states, result.inputs)
            values.append(fit.grid.log_loss)
        found[factor] = float(np.mean(values))
    assert found[1.0] < min(found[0.2], found[5.0])


def test_jacobians_are_those_of_automatic_differentiation() -> None:
    spec = trial("cartpole", "random")
    theta = run_trial(spec).parameters.astype(float)
    found = jacobian(spec, theta, evaluated(spec))
    states = torch.as_tensor(evaluation_set(spec.system).states)[None]
    function = mlp_function(spec.system, spec.model)
    expected = torch.func.jacrev(lambda one: function(one[None], states)[0])(torch.as_tensor(theta))
    assert found == pytest.approx(expected.numpy(), rel=1e-6, abs=1e-8)


def test_r_squared_is_one_for_the_truth_and_falls_with_the_error() -> None:
    spec = trial("pendulum", "random", **LINEAR)
    result = run_trial(spec)
    points, system = evaluation_set(spec.system), spec.system
    truth = np.array([getattr(system, name) for name in system.linear_parameters])
    exact = held_out_fit(spec, truth, result.states, result.inputs)
    assert exact.grid.r_squared == pytest.approx(1.0, abs=1e-12)
    assert exact.grid.covered == exact.reachable.covered == 1.0
    none = held_out_fit(spec, 0.0 * truth, result.states, result.inputs)
    a = points.accelerations[points.n_grid :]
    assert none.reachable.r_squared == pytest.approx(1 - np.sum(a**2) / np.sum((a - a.mean()) ** 2))


@pytest.mark.parametrize(
    ("policy", "sections"),
    [
        ("random", {}),  # a network that Adam teaches: nobody holds M
        ("d_optimal", {"env": {"noise": 0.0}}),
        ("gaussian_process", {}),
        ("random", {"model": {"name": "ensemble"}, "learner": {"name": "gauss_newton"}}),
    ],
)
def test_what_has_no_covariance_has_a_fit_alone(policy: str, sections: dict[str, Any]) -> None:
    found = fits(trial("pendulum", policy, **sections))
    for fit in found:
        assert np.isfinite(fit.r_squared)
        assert np.isnan(fit.covered)
        assert np.isnan(fit.log_loss)


def test_accelerations_that_depend_on_no_parameter_do_not_count() -> None:
    """As those of the quadrotor, whose drags are unknown, at rest: with them the mean is NaN."""
    spec = trial("quadrotor", "random", **LINEAR)
    result, points = run_trial(spec), evaluation_set(spec.system)
    rows = jacobian(spec, result.parameters, evaluated(spec))
    assert np.any(np.all(rows[points.n_grid :] == 0.0, axis=-1))
    found = held_out_fit(spec, result.parameters, result.states, result.inputs)
    assert np.isfinite(found.reachable.log_loss)
    assert np.isfinite(found.grid.log_loss)


def test_a_network_is_surer_of_states_that_it_was_taught() -> None:
    """Of samples around hanging: the intervals are wider far away, in proportion to the noise."""
    spec = trial("pendulum", "d_optimal", learner={"name": "gauss_newton"})
    near, far = np.array([[0.0, 0.0]]), np.array([[np.pi, 6.0]])
    result = run_trial(spec)
    samples = recorded_samples(spec.system, result.states, result.inputs)
    held = Information("primal", 1e-3)
    at = Samples(np.concatenate([near, far]), np.zeros((2, 1)), np.zeros((2, 1)))
    variances = predicted_variances(spec, result.parameters, held, samples, at)
    assert 0.0 < variances[0, 0] < 0.1 * variances[1, 0]
