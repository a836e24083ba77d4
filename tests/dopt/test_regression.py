"""Models that are linear in their parameters, and Gaussian processes, against dense algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dopt.kernel.run import KernelTrial
from dopt.models import RFF, GaussianProcess
from dopt.randomness import draw
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from tests.dopt.oracles.traces import observed, trace
from tests.dopt.trials import trial

LEARNERS = {"rff": "recursive_least_squares", "linear_state": "recursive_least_squares"} | {
    "gaussian_process": "conditioning"
}


def regression(env: str, model: str, policy: str = "random_held", /, **fields: Any) -> TrialSpec:
    """Return a small trial with one of the models."""
    sections: dict[str, Any] = {"model": {"name": model}, "learner": {"name": LEARNERS[model]}}
    if policy in ("d_optimal", "linear"):
        sections["policy"] = {"regularization": 1e-2}
    for key, entries in fields.items():
        sections[key] = sections.get(key, {}) | entries
    return trial(env, policy, 5, **sections)


@pytest.mark.parametrize("model", LEARNERS)
def test_the_stored_parameters_give_the_last_loss(model: str) -> None:
    spec = regression("arm", model)
    result = run_trial(spec)
    grid = spec.system.grid()
    errors = spec.model.predict(spec.system, result.parameters, grid) - spec.system.learned(grid)
    assert np.sqrt((errors**2).sum(axis=1).mean()) == pytest.approx(result.final_loss, rel=1e-5)


def test_random_features_have_the_kernel_in_expectation() -> None:
    model = RFF(n_features=40_000, lengthscale=0.7, amplitude=3.0)
    system = trial("pendulum", "random").system
    drawn = model.initial_parameters(system, np.random.default_rng(0))
    states = np.random.default_rng(1).normal(size=(5, 2))
    first = model.n_features
    frequencies = drawn[first:-first].reshape(first, 3)
    psi = model.scale * np.cos(system.featurize(states) @ frequencies.T + drawn[-first:])
    phi = system.featurize(states)
    expected = GaussianProcess(lengthscale=0.7, amplitude=3.0).kernel(phi, phi)
    assert psi @ psi.T == pytest.approx(expected, abs=0.15)


def test_random_features_stay_and_differ_from_seed_to_seed() -> None:
    spec = regression("arm", "rff")
    result = run_trial(spec)
    fixed = spec.model.n_fixed_parameters(spec.system)
    before = draw(spec).weights
    assert np.array_equal(result.parameters[-fixed:], before[-fixed:])
    assert np.all(before[:-fixed] == 0.0)
    assert np.all(result.parameters[:-fixed] != 0.0)
    assert np.all(draw(spec.with_seed(6)).weights[-fixed:] != before[-fixed:])


@pytest.mark.parametrize("policy", ["random_held", "d_optimal"])
@pytest.mark.parametrize(("env", "model"), [("arm", "rff"), ("mass_spring", "linear_state")])
def test_least_squares_minimise_the_ridge_loss(env: str, model: str, policy: str) -> None:
    """With the ridge of a policy that plans by the same matrix, or their own."""
    spec = regression(env, model, policy, learner={"regularization": 3e-2})
    run = trace(spec)
    states = run.states[:-1]
    targets = np.array([observed(spec, run, t) for t in range(len(states))])
    q = spec.model.n_parameters(spec.system) - spec.model.n_fixed_parameters(spec.system)
    drawn = draw(spec).weights
    units = np.concatenate([np.eye(q), np.tile(drawn[q:], (q, 1))], axis=1)
    columns = [spec.model.predict(spec.system, unit, states).ravel() for unit in units]
    ridge = 1e-2 if policy == "d_optimal" else 3e-2
    design = np.concatenate([np.stack(columns, axis=1), np.sqrt(ridge) * np.eye(q)])
    aims = np.concatenate([targets.ravel(), np.zeros(q)])
    expected = np.linalg.lstsq(design, aims, rcond=None)[0]
    found = run.parameters[-1][:q]
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-7 * np.abs(expected).max())


def test_information_of_random_features_is_about_the_learned_parameters_alone() -> None:
    spec = regression("arm", "rff", "d_optimal", model={"n_features": 20}, env={"horizon": 4})
    assert KernelTrial(spec).state.covariance.upper.shape == (40, 40)


def test_the_noise_of_a_process_is_that_of_the_trial_but_not_below_rounding() -> None:
    spec = regression("pendulum", "gaussian_process", env={"noise": 0.1})
    assert isinstance(spec.model, GaussianProcess)
    assert spec.model.noise_variance(spec.system) == pytest.approx(0.1**2 / 0.02)
    quiet = regression("pendulum", "gaussian_process", env={"noise": 0.0})
    assert spec.model.noise_variance(quiet.system) == pytest.approx(1e-8)
    assert run_trial(quiet).diverged_at is None
