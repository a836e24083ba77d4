"""Models that are linear in their parameters, and Gaussian processes, against dense algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from dopt.models import RFF, GaussianProcess
from dopt.randomness import draw
from dopt.reference.batch import Lockstep, run_trials
from dopt.reference.gaussian_process import Posterior
from dopt.reference.models import features
from dopt.spec.trial import TrialSpec
from tests.dopt.torch_models import model_of_one
from tests.dopt.trials import KNOWN_EFFECT, trial

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


def samples(batch: Lockstep) -> tuple[np.ndarray, np.ndarray]:
    """Return the states at which samples were taken, (T, d), and the samples, (T, r)."""
    return batch.states[0, :-1].numpy(), batch.targets[0].numpy()


def run(spec: TrialSpec) -> Lockstep:
    batch = Lockstep([spec])
    with torch.no_grad():
        for t in range(spec.system.horizon):
            batch.step(t)
    return batch


@pytest.mark.parametrize("model", LEARNERS)
@pytest.mark.parametrize("env", KNOWN_EFFECT)
def test_prediction_is_that_of_the_reference(env: str, model: str) -> None:
    spec = regression(env, model)
    rng = np.random.default_rng(1)
    theta = rng.normal(size=spec.model.n_parameters(spec.system))
    states = rng.normal(size=(6, spec.system.n_states))
    reference = model_of_one(spec.system, spec.model)
    expected = [reference(torch.tensor(theta), torch.tensor(x)).numpy() for x in states]
    predicted = spec.model.predict(spec.system, theta, states)
    np.testing.assert_allclose(predicted, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("model", LEARNERS)
def test_the_stored_parameters_give_the_last_loss(model: str) -> None:
    spec = regression("arm", model)
    result = run_trials([spec])[0]
    grid = spec.system.grid()
    errors = spec.model.predict(spec.system, result.parameters, grid) - spec.system.learned(grid)
    assert np.sqrt((errors**2).sum(axis=1).mean()) == pytest.approx(result.final_loss, rel=1e-9)


@pytest.mark.parametrize("model", LEARNERS)
@pytest.mark.parametrize("policy", ["d_optimal", "uniform", "random"])
def test_a_batch_is_its_trials_one_by_one(model: str, policy: str) -> None:
    if (model, policy) == ("gaussian_process", "d_optimal"):
        policy = "gaussian_process"
    spec = regression("quadrotor", model, policy, env={"horizon": 10})
    together = run_trials([spec.with_seed(seed) for seed in range(3)])
    for seed, many in enumerate(together):
        one = run_trials([spec.with_seed(seed)])[0]
        assert many.inputs == pytest.approx(one.inputs, rel=1e-6, abs=1e-6)
        assert many.loss == pytest.approx(one.loss, rel=1e-6)


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
    result = run_trials([spec])[0]
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
    batch = run(spec)
    states, targets = samples(batch)
    q = spec.model.n_parameters(spec.system) - spec.model.n_fixed_parameters(spec.system)
    drawn = draw(spec).weights
    units = np.concatenate([np.eye(q), np.tile(drawn[q:], (q, 1))], axis=1)
    columns = [spec.model.predict(spec.system, unit, states).ravel() for unit in units]
    ridge = 1e-2 if policy == "d_optimal" else 3e-2
    design = np.concatenate([np.stack(columns, axis=1), np.sqrt(ridge) * np.eye(q)])
    aims = np.concatenate([targets.ravel(), np.zeros(q)])
    expected = np.linalg.lstsq(design, aims, rcond=None)[0]
    found = batch.theta[0, :q].numpy()
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-7 * np.abs(expected).max())


def test_information_of_random_features_is_about_the_learned_parameters_alone() -> None:
    spec = regression("arm", "rff", "d_optimal", model={"n_features": 20}, env={"horizon": 4})
    batch = run(spec)
    assert batch.information is not None
    assert batch.information.size == 40


@pytest.mark.parametrize("env", ["pendulum", "arm"])
def test_the_posterior_is_that_of_dense_algebra(env: str) -> None:
    spec = regression(env, "gaussian_process", env={"noise": 0.02})
    batch, system, model = run(spec), spec.system, spec.model
    assert isinstance(model, GaussianProcess)
    states, targets = samples(batch)
    phi = system.featurize(states)
    noise = system.noise**2 / system.dt
    covariance = model.kernel(phi, phi) + noise * np.eye(len(phi))
    at = np.random.default_rng(0).normal(size=(2, 3, system.n_states))
    posterior = batch.learner
    assert isinstance(posterior, Posterior)
    z = features(system, torch.tensor(at)[None])
    entropies = posterior.entropies(z)[0]
    for i, few in enumerate(at):
        cross = model.kernel(system.featurize(few), phi)
        mean = cross @ np.linalg.solve(covariance, targets)
        predicted = model.predict(system, batch.theta[0].numpy(), few)
        assert predicted == pytest.approx(mean, rel=1e-6, abs=1e-6)
        assert posterior.predict(z[:, i])[0].numpy() == pytest.approx(mean, rel=1e-6, abs=1e-6)
        own = model.kernel(system.featurize(few), system.featurize(few))
        left = own - cross @ np.linalg.solve(covariance, cross.T) + noise * np.eye(3)
        assert float(entropies[i]) == pytest.approx(np.linalg.slogdet(left)[1], rel=1e-6)


def test_the_noise_of_a_process_is_that_of_the_trial_but_not_below_rounding() -> None:
    spec = regression("pendulum", "gaussian_process", env={"noise": 0.1})
    assert isinstance(spec.model, GaussianProcess)
    assert spec.model.noise_variance(spec.system) == pytest.approx(0.1**2 / 0.02)
    quiet = regression("pendulum", "gaussian_process", env={"noise": 0.0})
    assert spec.model.noise_variance(quiet.system) == pytest.approx(1e-8)
    assert run_trials([quiet])[0].diverged_at is None


@pytest.mark.parametrize("lookahead", [1, 4])
@pytest.mark.parametrize("env", ["pendulum", "quadrotor"])
def test_a_process_is_asked_where_it_knows_least(env: str, lookahead: int) -> None:
    spec = regression(env, "gaussian_process", "gaussian_process", policy={"lookahead": lookahead})
    batch, system, gamma = run(spec), spec.system, spec.system.gamma
    x, theta = batch.states[0, -1].numpy(), batch.theta[0].numpy()
    posterior, plan = batch.learner, batch.own_plan
    assert isinstance(posterior, Posterior)
    assert plan is not None
    chosen = plan.plan(system.horizon)[0].numpy()
    angles = 2 * np.pi / 16 * np.arange(16)
    circle = gamma * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    tried = circle if system.n_inputs == 2 else np.array([[gamma], [-gamma]])
    values = []
    for u in tried:
        z, visited = x, []
        for _ in range(lookahead):
            step = np.array(system.known(tuple(z), tuple(u), system.parameters))
            step[list(system.learned_rows)] += spec.model.predict(system, theta, z[None])[0]
            z = z + system.dt * step
            visited.append(z)
        phi = features(system, torch.tensor(np.stack(visited)))
        values.append(float(posterior.entropies(phi[None, None])[0, 0]))
    assert chosen == pytest.approx(tried[np.argmax(values)])
