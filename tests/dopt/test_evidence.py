"""Gaussian processes whose kernels follow from their evidence, against dense matrices."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from dopt import Explorer
from dopt.errors import IncompatibleError
from dopt.kernel.evidence import fit_numbers, guessed
from dopt.kernel.gaussian_process import negative_evidence
from dopt.kernel.run import trial_in_kernel
from dopt.models import gaussian_process
from dopt.models.gaussian_process import GaussianProcess, kernel
from dopt.offline_fit import fit_offline, grid_loss, recorded_samples
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.explorer.plants import MOTOR, drive, motor_acceleration
from tests.dopt.oracles.traces import following, trace
from tests.dopt.trials import trial


def tuned(env: str, policy: str, seed: int = 0, /, **fields: Any) -> TrialSpec:
    """Return a small trial with a kernel that the evidence chooses."""
    model = {"name": "gaussian_process", "hyperparameters": "evidence", **fields.pop("model", {})}
    learner = {"name": "conditioning", **fields.pop("learner", {})}
    return trial(env, policy, seed, model=model, learner=learner, **fields)


def drawn(seed: int, n: int = 12, p: int = 3) -> tuple[Array, Array, Array, Array]:
    """Return features (p, n), accelerations, counts and numbers of a kernel."""
    rng = np.random.default_rng(seed)
    numbers = np.exp(0.5 * rng.standard_normal(2 * p + 3))
    return rng.standard_normal((p, n)), rng.standard_normal(n), rng.uniform(1, 4, n), numbers


def density(phi: Array, y: Array, counts: Array, numbers: Array) -> float:
    covariance = kernel(numbers, phi.T, phi.T) + np.diag(numbers[-1] / counts)
    return float(multivariate_normal(cov=covariance).logpdf(y))


@pytest.mark.parametrize("seed", range(3))
def test_the_evidence_is_the_density_of_the_samples(seed: int) -> None:
    phi, y, counts, numbers = drawn(seed)
    slope, change = np.empty(len(numbers)), 1e-5
    value = negative_evidence(numbers, phi, y, counts, slope)
    assert value == pytest.approx(-density(phi, y, counts, numbers), rel=1e-12)
    for j in range(len(numbers)):
        ends = []
        for sign in (1.0, -1.0):
            moved = numbers.copy()
            moved[j] *= np.exp(sign * change)
            ends.append(-density(phi, y, counts, moved))
        difference = (ends[0] - ends[1]) / (2 * change)
        assert slope[j] == pytest.approx(difference, rel=1e-6, abs=1e-7)


def test_a_fit_finds_the_numbers_that_made_the_samples() -> None:
    rng, p, n = np.random.default_rng(5), 2, 250
    phi, truth = rng.uniform(-2, 2, (p, n)), np.array([4.0, 0.25, 9.0, 1e-3, 1e-3, 1e-3, 0.01])
    covariance = kernel(truth, phi.T, phi.T) + truth[-1] * np.eye(n)
    y, counts = np.linalg.cholesky(covariance) @ rng.standard_normal(n), np.ones(n)
    for noise in (None, truth[-1]):
        numbers = fit_numbers(phi, y, counts, [guessed(phi, y)], noise, 60)
        assert np.log(numbers[:2] / truth[:2]) == pytest.approx(0.0, abs=1.0)
        assert numbers[-1] == pytest.approx(truth[-1], rel=0.3)
        assert density(phi, y, counts, numbers) > density(phi, y, counts, truth) - 3.0


def dense(spec: TrialSpec, states: Array, targets: Array, numbers: Array, x: Array) -> Array:
    """Return posterior means, (N, r), at states, (N, d), from all samples at once."""
    seen, phi = spec.system.featurize(states), spec.system.featurize(x)
    columns = []
    for k, row in enumerate(numbers):
        K = kernel(row, seen, seen) + row[-1] * np.eye(len(seen))
        columns.append(kernel(row, phi, seen) @ np.linalg.solve(K, targets[:, k]))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("env", ["pendulum", "cartpole"])
@pytest.mark.parametrize("policy", ["random", "exact", "lookahead", "episodic"])
def test_the_model_of_a_trial_is_the_posterior_of_its_samples(env: str, policy: str) -> None:
    spec = tuned(env, policy, 3, env={"noise": 0.1})
    one = trial_in_kernel(spec)
    one.advance(spec.system.horizon)
    assert one.evidence is not None
    samples = recorded_samples(spec.system, one.record.states, one.record.inputs)
    grid = np.random.default_rng(0).standard_normal((7, spec.system.n_states))
    expected = dense(spec, samples.states, samples.accelerations, one.evidence.numbers, grid)
    found = spec.model.predict(spec.system, one.parameters, grid)
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-6 * np.abs(expected).max())
    last = spec.system.horizon - 1
    # The last fit came before the last evaluation, whose kernels were written again.
    assert one.record.loss[last] == pytest.approx(grid_loss(spec, one.parameters), rel=1e-9)


def test_the_input_is_the_one_of_most_information() -> None:
    spec = tuned("quadrotor", "exact", 1, policy={"candidates": 5})
    run = trace(spec)
    size, r = 2 * len(spec.system.features) + 3, spec.system.n_learned
    assert hasattr(spec.policy, "compared_inputs")
    candidates = spec.policy.compared_inputs(spec.system)
    for t in (3, 11, 25):
        numbers = run.parameters[t][-r * size :].reshape(r, size)
        values, seen = [], spec.system.featurize(run.states[:t])
        mean = spec.model.predict(spec.system, run.parameters[t], run.states[t][None])[0]
        for u in candidates:
            phi, gain = spec.system.featurize(following(spec, run.states[t], u, mean)[None]), 0.0
            for row in numbers:
                K, cross = kernel(row, seen, seen) + row[-1] * np.eye(t), kernel(row, phi, seen)
                rest = kernel(row, phi, phi) - cross @ np.linalg.solve(K, cross.T)
                gain += float(np.log1p(max(rest[0, 0], 0.0) / row[-1]))
            values.append(gain)
        chosen = np.flatnonzero((candidates == run.inputs[t]).all(axis=1))
        assert values[chosen[0]] >= max(values) - 1e-6 * np.ptp(values)


def test_the_same_trial_has_the_same_bits() -> None:
    spec = tuned("cartpole", "episodic", 2, policy={"domain": "box"})
    first, second = run_trial(spec), run_trial(spec)
    assert np.array_equal(first.parameters, second.parameters)
    assert np.array_equal(first.loss, second.loss)


@pytest.mark.parametrize(
    ("policy", "fields"),
    [("d_optimal", {}), ("icem", {"criterion": "task"}), ("a_optimal", {}), ("task", {})],
)
def test_a_policy_that_needs_parameters_is_refused(policy: str, fields: dict[str, str]) -> None:
    with pytest.raises(IncompatibleError, match=r"'exact', 'trace', 'lookahead'"):
        tuned("pendulum", policy, policy=fields)


def test_an_offline_fit_reads_the_samples() -> None:
    spec = tuned("pendulum", "random", 4, env={"horizon": 120, "grid_points": [8, 8]})
    rng = np.random.default_rng(1)
    states = rng.uniform(-1, 1, (120, 2)) * [np.pi, 2.0]
    truth = spec.system.learned(states, 0)
    fit = fit_offline(spec, states, truth + 0.01 * rng.standard_normal(truth.shape))
    assert isinstance(spec.model, GaussianProcess)
    fixed = dataclasses.replace(spec.model, hyperparameters="fixed")
    other = TrialSpec(dataclasses.replace(spec.config, model=fixed), spec.seed)
    assert fit.loss < 0.3 * fit_offline(other, states, truth).loss
    assert fit.residual < 0.02


def test_what_adds_little_is_merged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gaussian_process, "MOST_SAMPLES", 60)
    spec = tuned("pendulum", "random", 1, env={"horizon": 300, "noise": 0.3})
    one = trial_in_kernel(spec)
    one.advance(300)
    posterior, n = one.trial.state.posterior, int(one.trial.network.process.n_samples[0])
    assert posterior.factors.shape == (2, 60, 60)  # the second for a refit beside
    assert n <= 60
    assert posterior.counts[:n].sum() == 300
    assert one.record.loss[299] == pytest.approx(grid_loss(spec, one.parameters), rel=1e-9)
    monkeypatch.undo()
    whole = run_trial(tuned("pendulum", "random", 1, env={"horizon": 300, "noise": 0.3}))
    assert one.record.loss[299] < 2.0 * whole.loss[299]


def test_numbers_that_leave_the_matrix_indefinite_do_not_come_into_force() -> None:
    one = trial_in_kernel(tuned("cartpole", "random", 1))
    one.advance(30)
    assert one.evidence is not None
    before, parameters = one.evidence.numbers.copy(), one.parameters.copy()
    wrong = before.copy()
    wrong[:, -1] = -2.0 * before.max()  # no noise has such a variance
    one.evidence.take(wrong, 30)
    assert np.array_equal(one.evidence.numbers, before)
    assert one.parameters == pytest.approx(parameters, rel=1e-6, abs=1e-6 * parameters.max())


PARTS: dict[str, Any] = {
    "policy": "exact",
    "model": {"name": "gaussian_process", "hyperparameters": "evidence"},
    "learner": "conditioning",
}


def test_an_exploration_refits_beside_the_rig_and_its_journal_replays(tmp_path: Path) -> None:
    journal, begin = tmp_path / "rig.journal", np.array([0.1, 0.0])
    with Explorer(MOTOR, steps=90, journal=journal, **PARTS) as one:
        x = drive(one, 60, begin)
        assert one.counts["refits"] >= 5
        before = one.parameters.copy()
    with Explorer(MOTOR, steps=90, journal=journal, **PARTS) as again:
        assert np.array_equal(again.parameters, before)
        drive(again, 30, x)
        states = np.random.default_rng(0).uniform(-1, 1, (40, 2)) * [np.pi, 5.0]
        truth = np.array([motor_acceleration(x) for x in states])
        error = again.predict(states)[:, 0] - truth
        assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(truth**2))
