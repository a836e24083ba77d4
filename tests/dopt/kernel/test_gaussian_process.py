"""Gaussian process in the compiled kernel: against dense algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dopt.assessment import model_forecast
from dopt.kernel.run import KernelTrial
from dopt.models import GaussianProcess
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from tests.close import assert_close
from tests.dopt.trials import trial


def process(
    env: str, policy: str = "gaussian_process", seed: int = 3, /, **fields: Any
) -> TrialSpec:
    """Return a small trial that learns a Gaussian process."""
    sections = {"model": {"name": "gaussian_process"}, "learner": {"name": "conditioning"}}
    for key, entries in fields.items():
        sections[key] = sections.get(key, {}) | entries
    return trial(env, policy, seed, **sections)


def covariance(spec: TrialSpec, states: np.ndarray) -> np.ndarray:
    """Return K + σ²/dt I at states, (n, d)."""
    assert isinstance(spec.model, GaussianProcess)
    phi = spec.system.featurize(states)
    noise = spec.model.noise_variance(spec.system)
    return spec.model.kernel(phi, phi) + noise * np.eye(len(states))


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 1000),
    lengthscale=st.floats(0.3, 3.0),
    amplitude=st.floats(0.5, 20.0),
    noise=st.floats(0.005, 0.1),
)
def test_the_growing_factor_is_that_of_a_fresh_factorisation(
    seed: int, lengthscale: float, amplitude: float, noise: float
) -> None:
    sizes = {"horizon": 40, "noise": noise}
    model = {"lengthscale": lengthscale, "amplitude": amplitude}
    fast = KernelTrial(process("pendulum", "gaussian_process", seed, env=sizes, model=model))
    fast.advance(40)
    K = covariance(fast.spec, fast.states[:40])
    factor = np.tril(fast.state.posterior.factor)
    assert_close(factor, np.linalg.cholesky(K), abs=1e-8 * amplitude)
    assert_close(factor @ factor.T, K, abs=1e-12 * amplitude**2)


@pytest.mark.parametrize("env", ["pendulum", "arm"])
def test_the_mean_is_that_of_dense_algebra(env: str) -> None:
    spec = process(env, env={"noise": 0.02})
    fast = KernelTrial(spec)
    fast.advance(30)
    system, x, u = spec.system, fast.states, fast.record.inputs
    known = np.stack(
        [
            system.known(tuple(a), tuple(b), system.parameters)
            for a, b in zip(x[:-1], u, strict=True)
        ]
    )
    observed = ((x[1:] - x[:-1]) / system.dt - known)[:, list(system.learned_rows)]
    at = np.random.default_rng(0).normal(size=(4, system.n_states))
    assert isinstance(spec.model, GaussianProcess)
    cross = spec.model.kernel(system.featurize(at), system.featurize(x[:-1]))
    mean = cross @ np.linalg.solve(covariance(spec, x[:-1]), observed)
    predicted = spec.model.predict(system, fast.parameters, at)
    assert predicted == pytest.approx(mean, rel=1e-6, abs=1e-6)


def test_stored_parameters_give_the_last_loss() -> None:
    spec = process("arm")
    result, grid = run_trial(spec), spec.system.grid()
    errors = spec.model.predict(spec.system, result.parameters, grid) - spec.system.learned(grid)
    assert np.sqrt((errors**2).sum(axis=1).mean()) == pytest.approx(result.final_loss, rel=1e-9)


def test_where_a_trial_is_cut_makes_no_difference() -> None:
    whole, pieces = KernelTrial(process("arm")), KernelTrial(process("arm"))
    whole.advance(30)
    for last in (1, 2, 17, 30):
        pieces.advance(last)
    np.testing.assert_array_equal(pieces.record.loss, whole.record.loss)
    np.testing.assert_array_equal(pieces.parameters, whole.parameters)


def test_an_assessment_predicts_with_the_process() -> None:
    spec = process("arm", env={"horizon": 20})
    parameters, rng = run_trial(spec).parameters, np.random.default_rng(1)
    x = rng.normal(size=(5, spec.system.n_states))
    u = rng.normal(size=(5, 1, spec.system.n_inputs))
    flow = np.stack(spec.system.known(tuple(x.T), tuple(u[:, 0].T), spec.system.parameters))
    flow[list(spec.system.learned_rows)] += spec.model.predict(spec.system, parameters, x).T
    following = model_forecast(spec.system, spec.model, parameters)(x, u)[0]
    assert following == pytest.approx(x + spec.system.dt * flow.T, rel=1e-12)
