"""Offline fits, calibration at held-out states, errors of parameters and predictions."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
import pytest

from dopt.assessment import parameter_error, true_parameters
from dopt.errors import SpecificationError
from dopt.evaluation import evaluation_set, random_transitions
from dopt.kernel import joint_kalman
from dopt.kernel.linear_algebra import dense
from dopt.kernel.run import KernelTrial
from dopt.offline_fit import (
    RIDGE,
    HeldOut,
    Samples,
    fit_offline,
    grid_loss,
    held_out_fit,
    jacobian,
    predicted_variances,
    recorded_samples,
)
from dopt.randomness import draw, initial_weights
from dopt.run import rerun, run_trial
from dopt.spec.compatibility import Information
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from dopt.types import Array
from tests.dopt.kernel.twin import interpreted
from tests.dopt.oracles.test_oracles import filtered
from tests.dopt.oracles.traces import jacobian as complex_jacobian
from tests.dopt.oracles.traces import model_step, observed
from tests.dopt.test_limits import ANGLE, DEGREE, sensed
from tests.dopt.trials import trial, uniform_samples

SMALL = {"width": 4, "depth": 2}


def small(env: str, horizon: int = 60, seed: int = 2) -> TrialSpec:
    """Return a trial with a small network."""
    return trial(env, "random", seed, env={"horizon": horizon}, model=SMALL)


def taught(spec: TrialSpec, states: Array) -> tuple[Array, Array]:
    """Return the parameters of another network of the same shape, and its accelerations."""
    theta = initial_weights(spec.with_seed(spec.seed + 1))
    return theta, spec.model.predict(spec.system, theta, states)


@pytest.mark.parametrize("env", ["pendulum", "arm"])
def test_a_network_teacher_without_noise_is_recovered(env: str) -> None:
    spec = small(env, 300)
    x = uniform_samples(spec).states
    theta, y = taught(spec, x)
    fitted = fit_offline(spec, x, y, ridge=1e-10)
    grid = spec.system.grid()
    truth, found = (
        spec.model.predict(spec.system, one, grid) for one in (theta, fitted.parameters)
    )
    assert fitted.converged
    assert fitted.residual < 1e-3 * np.std(y)
    few = fit_offline(spec, x, y, ridge=1e-10, max_steps=3)
    assert (few.steps, few.converged) == (3, False)
    assert np.sqrt(np.mean((found - truth) ** 2)) < 2e-3 * np.std(truth)


@pytest.mark.parametrize("ridge", [1e-2, RIDGE])
@pytest.mark.parametrize("env", ["pendulum", "cartpole"])
def test_a_fit_ends_at_a_minimum_of_its_objective(env: str, ridge: float) -> None:
    spec = small(env)
    samples = uniform_samples(spec)
    fitted = fit_offline(spec, samples.states, samples.accelerations, ridge=ridge)
    theta, prior = fitted.parameters, initial_weights(spec)
    J = complex_jacobian(spec, theta, samples.states).reshape(-1, len(theta))
    e = (samples.accelerations - spec.model.predict(spec.system, theta, samples.states)).ravel()
    slope = J.T @ e + ridge * (prior - theta)
    value = e @ e + ridge * np.sum((theta - prior) ** 2)
    foreseen = slope @ np.linalg.solve(J.T @ J + ridge * np.eye(len(theta)), slope)
    assert fitted.converged
    assert foreseen < 1e-4 * value  # what an undamped step would still gain
    np.testing.assert_allclose(fitted.residual, np.sqrt(e @ e / len(samples.states)), rtol=1e-9)


def test_each_network_of_an_ensemble_is_fitted_by_itself() -> None:
    spec = small("pendulum")
    model, learner = {"name": "ensemble", "members": 3}, {"name": "gauss_newton"}
    sizes = {"env": {"horizon": 60}, "model": SMALL | model, "learner": learner}
    together = trial("pendulum", "random", 2, **sizes)
    samples = uniform_samples(spec)
    fitted = fit_offline(together, samples.states, samples.accelerations)
    first, *others = fitted.parameters.reshape(3, -1)
    alone = fit_offline(spec, samples.states, samples.accelerations)
    assert np.array_equal(first, alone.parameters)
    assert fitted.steps >= alone.steps
    assert fitted.loss == grid_loss(together, fitted.parameters)
    drawn = initial_weights(together).reshape(3, -1)
    for member, start in zip(others, drawn[1:], strict=True):
        assert not np.allclose(member, first)
        e = samples.accelerations - spec.model.predict(spec.system, member, samples.states)
        J = complex_jacobian(spec, member, samples.states).reshape(-1, len(member))
        slope = J.T @ e.ravel() + RIDGE * (start - member)
        assert np.linalg.norm(slope) < 1e-2 * np.linalg.norm(start - member)


def test_a_fit_of_a_linear_model_is_the_ridge_solution_and_recovers_the_physics() -> None:
    spec = trial("arm", "oracle", 1, env={"horizon": 200})
    samples = uniform_samples(spec)
    fitted = fit_offline(spec, samples.states, samples.accelerations)
    truth = [getattr(spec.system, name) for name in spec.system.linear_parameters]
    np.testing.assert_allclose(fitted.parameters, np.array(truth), rtol=0.0, atol=1e-2)
    assert fitted.loss < 1e-2


@pytest.mark.parametrize("env", ["pendulum", "quadrotor", "drifting_pendulum"])
def test_recorded_samples_are_what_the_learner_was_given(env: str) -> None:
    spec = small(env)
    running = KernelTrial(spec)
    running.advance(spec.system.horizon)
    samples = recorded_samples(spec.system, running.record.states, running.record.inputs)
    given = observed(spec, running.record)
    np.testing.assert_allclose(samples.accelerations, given, rtol=5e-10, atol=5e-10)
    assert np.array_equal(samples.states, rerun(spec, [spec.system.horizon]).states[:-1])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"ridge": 0}, "ridge is 0, but a number above 0 is expected"),
        ({"ridge": float("nan")}, "ridge is nan"),
        ({"max_steps": 0}, "max_steps is 0, but a whole number of at least 1"),
        ({"states": np.zeros((60, 1))}, r"states of shape \(60, 1\)"),
        ({"accelerations": np.zeros((59, 1))}, "60 states and 59 accel"),
        ({"states": np.full((60, 2), np.nan)}, r"row 0 of the states is \[nan, nan\], but finite"),
    ],
)
def test_bad_input_gets_a_sentence(changes: dict[str, Any], words: str) -> None:
    good = {"states": np.zeros((60, 2)), "accelerations": np.zeros((60, 1))}
    with pytest.raises(SpecificationError, match=words):
        fit_offline(small("pendulum"), **(good | changes))


def test_a_model_without_an_offline_fit_is_refused() -> None:
    grey = trial("pendulum", "random", 1, model={"name": "grey_box"}, learner={"name": "ekf"})
    with pytest.raises(SpecificationError, match=r"model 'grey_box' has no offline fit, but 'mlp'"):
        fit_offline(grey, np.zeros((60, 2)), np.zeros((60, 1)))


def test_fixed_parameters_of_a_linear_model_stay() -> None:
    model = {"name": "rff", "n_features": 30}
    learner = {"name": "recursive_least_squares"}
    spec = trial("pendulum", "random", 1, model=model, learner=learner, env={"horizon": 100})
    samples = uniform_samples(spec)
    fitted = fit_offline(spec, samples.states, samples.accelerations)
    fixed = spec.model.n_fixed_parameters(spec.system)
    assert np.array_equal(fitted.parameters[-fixed:], initial_weights(spec)[-fixed:])
    assert fitted.loss < 0.2 * grid_loss(spec, initial_weights(spec))


def test_a_black_box_is_fitted_to_transitions_of_runs_of_its_own() -> None:
    pytest.importorskip("gymnasium")
    env = {"_target_": "tests.dopt.custom_environments.Point", "horizon": 40}
    spec = TrialSpec.from_names(env, "random")
    system: Any = spec.system
    samples = Samples(*random_transitions(system, 40, np.random.default_rng(0)))
    assert len(samples.states) == 40
    fitted = fit_offline(spec, samples.states, samples.accelerations)
    assert fitted.loss < grid_loss(spec, initial_weights(spec))


def test_variances_are_those_of_state_and_parameters_in_one_filter() -> None:
    sensors = {"measured_states": [0], "measurement_noise": [DEGREE]}
    fast = KernelTrial(sensed("pendulum", sensors, horizon=13, refit_every=1000))
    fast.advance(12)
    expected = filtered(fast.spec, fast.state.estimate.outputs[:12], fast.record.inputs[:12])[2]
    found = interpreted(joint_kalman.state_variances)(fast.trial, 12)
    np.testing.assert_allclose(found, expected[:2], rtol=1e-3)


def test_true_parameters_are_those_of_the_step() -> None:
    worn = SYSTEMS["drifting_pendulum"]()
    names = worn.linear_parameters
    first, last = (true_parameters(worn, step) for step in (0, worn.horizon + 5))
    assert first[names.index("friction")] == worn.friction
    assert last[names.index("friction")] == worn.history[-1][worn.physical.index("friction")]
    assert parameter_error(worn, first, worn.horizon) == pytest.approx(abs(last - first).max())


class Innovations(NamedTuple):
    """What the filter of the state leaves at some parameters, step by step."""

    gains: list[Array]  # K, (d,)
    errors: Array  # e, (n,)
    variances: Array  # s, (n,)

    @property
    def unlikelihood(self) -> float:
        """Return Σ (e²/s + log s)."""
        return float(np.sum(self.errors**2 / self.variances + np.log(self.variances)))


def innovations(
    fast: KernelTrial, theta: Array, rho: float = 0.1, gains: list[Array] | None = None
) -> Innovations:
    """Filter the angle of a pendulum at parameters and a noise; gains that are given are held."""
    spec, x, P = fast.spec, fast.record.states[0], np.zeros((2, 2))
    kept, errors, variances = [], [], []
    for t, u in enumerate(fast.record.inputs):
        step = 1e-6 * np.eye(2)
        ends = [[model_step(spec, theta, x + sign * e, u) for e in step] for sign in (1, -1)]
        A = (np.array(ends[0]) - np.array(ends[1])).T / 2e-6
        P = A @ P @ A.T + np.diag([0.0, spec.system.dt**2 * rho])
        variances.append(P[0, 0] + DEGREE**2)
        K = P[:, 0] / variances[-1]
        P = P - np.outer(K, K) * variances[-1]
        kept.append(K if gains is None else gains[t])
        x = model_step(spec, theta, x, u)
        errors.append(fast.state.estimate.outputs[t, 0] - x[0])
        x = x + kept[-1] * errors[-1]
    return Innovations(kept, np.array(errors), np.array(variances))


def after_fit(horizon: int = 20, **learner: Any) -> KernelTrial:
    """Return a trial of a small network that ends with a fit of all that was measured."""
    spec = sensed("pendulum", ANGLE, horizon=horizon, refit_every=horizon, **learner)
    small = {"model": {"name": "mlp", "width": 4}}
    fast = KernelTrial(TrialSpec.from_mapping(spec.to_mapping() | small))
    fast.advance(horizon)
    return fast


def objective(fast: KernelTrial, theta: Array) -> float:
    """Return Σ (e²/s + log s) + λ‖θ - θ₀‖², λ being the policy's."""
    prior = draw(fast.spec).weights
    return innovations(fast, theta).unlikelihood + 3.0 * float(np.sum((theta - prior) ** 2))


def test_a_fit_finds_parameters_at_which_all_that_was_measured_is_likelier() -> None:
    one, eight = (after_fit(60, steps=steps) for steps in (1, 8))
    found = [objective(fast, fast.state.theta.copy()) for fast in (one, eight)]
    assert found[1] <= found[0] < objective(one, draw(one.spec).weights)


def test_the_information_after_a_fit_is_in_the_derivatives_of_the_innovations() -> None:
    """With the gains held, as in the step of Gauss and Newton: M = λI + Σ ∂e/∂θᵀ ∂e/∂θ / s."""
    fast = after_fit()
    theta = fast.state.theta.copy()
    held = innovations(fast, theta)
    ends = [
        [innovations(fast, theta + sign * e, gains=held.gains).errors for sign in (1, -1)]
        for e in 1e-5 * np.eye(len(theta))
    ]
    rows = np.array([(ahead - behind) / 2e-5 for ahead, behind in ends]) / held.variances**0.5
    expected = 3.0 * np.eye(len(theta)) + rows @ rows.T
    np.testing.assert_allclose(
        dense(fast.state.covariance) @ expected, np.eye(len(theta)), atol=1e-4
    )


def test_a_fitted_noise_is_the_likeliest_of_its_neighbours() -> None:
    fast = after_fit(60, noise="fitted", noise_variance=3.0)
    fitted, theta = float(fast.state.estimate.noise_variance[0]), fast.state.theta.copy()
    moves = abs(math.log10(fitted / 3.0)) / math.log10(joint_kalman.NOISE_FACTORS[0])
    assert 0.5 < moves < joint_kalman.MOST_NOISE_FACTORS - 0.5
    lowest, *others = (
        innovations(fast, theta, factor * fitted).unlikelihood
        for factor in (1.0, *joint_kalman.NOISE_FACTORS)
    )
    assert lowest <= min(others)


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
    """Over trials, whose noise differs, 90 % of the intervals hold."""
    specs = [trial("pendulum", "random", seed, env={"noise": 1e-2}, **LINEAR) for seed in range(40)]
    # Two parameters are unknown, so the errors of a trial go together: standard error 0.035.
    assert np.mean([fits(spec).grid.covered for spec in specs]) == pytest.approx(0.9, abs=0.1)


def test_the_log_loss_of_a_linear_model_is_lowest_with_the_covariance_of_the_noise() -> None:
    """Trials that are judged by another noise than they had are judged too narrow or too wide."""
    found: dict[float, list[float]] = {0.2: [], 1.0: [], 5.0: []}
    for seed in range(20):
        spec = trial("pendulum", "random", seed, **LINEAR)
        result = run_trial(spec)
        for factor, values in found.items():
            other = dataclasses.replace(spec.system, noise=factor * spec.system.noise)
            judged = dataclasses.replace(spec.config, system=other)
            given = result.parameters, result.states, result.inputs
            fit = held_out_fit(dataclasses.replace(spec, config=judged), *given)
            values.append(fit.grid.log_loss)
    assert sum(found[1.0]) < min(sum(found[0.2]), sum(found[5.0]))


def test_jacobians_are_those_of_complex_steps() -> None:
    spec = trial("cartpole", "random", model={"width": 4})
    theta, at = initial_weights(spec), evaluated(spec)
    expected = complex_jacobian(spec, theta, at.states)
    assert jacobian(spec, theta, at) == pytest.approx(expected, rel=1e-6, abs=1e-8)


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
    """Such as the quadrotor's at rest, whose drags are unknown: with them the mean is NaN."""
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
