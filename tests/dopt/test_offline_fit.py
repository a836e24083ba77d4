"""Offline fits: minima of their objective, models that can be recovered, samples, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.func import jacrev, vmap

import dopt
from dopt.errors import SpecificationError
from dopt.offline_fit import (
    RIDGE,
    Samples,
    fit_offline,
    grid_loss,
    recorded_samples,
    uniform_samples,
)
from dopt.randomness import draw, initial_weights
from dopt.run import rerun
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.close import assert_close
from tests.dopt.kernel.twin import observed
from tests.dopt.torch_models import model_of_one
from tests.dopt.trials import trial

SMALL = {"width": 4, "depth": 2}


def small(env: str, horizon: int = 60, seed: int = 2) -> TrialSpec:
    """Return a trial with a small network."""
    return trial(env, "random", seed, env={"horizon": horizon}, model=SMALL)


def taught(spec: TrialSpec, states: Array) -> tuple[Array, Array]:
    """Return the parameters of another network of the same shape, and its accelerations."""
    theta = initial_weights(spec.with_seed(spec.seed + 1))
    return theta, spec.model.predict(spec.system, theta, states)


def jacobian(spec: TrialSpec, theta: Array, states: Array) -> Array:
    """Return ∂a_θ(x)/∂θ, (N r, q), by automatic differentiation."""
    model = model_of_one(spec.system, spec.model)
    rows = vmap(jacrev(model), in_dims=(None, 0))(torch.tensor(theta), torch.tensor(states))
    return rows.flatten(0, 1).numpy()


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
    assert np.sqrt(np.mean((found - truth) ** 2)) < 2e-3 * np.std(truth)


@pytest.mark.parametrize("ridge", [1e-2, RIDGE])
@pytest.mark.parametrize("env", ["pendulum", "cartpole"])
def test_a_fit_ends_at_a_minimum_of_its_objective(env: str, ridge: float) -> None:
    spec = small(env)
    samples = uniform_samples(spec)
    fitted = fit_offline(spec, samples.states, samples.accelerations, ridge=ridge)
    theta, prior = fitted.parameters, initial_weights(spec)
    J = jacobian(spec, theta, samples.states)
    e = (samples.accelerations - spec.model.predict(spec.system, theta, samples.states)).ravel()
    slope = J.T @ e + ridge * (prior - theta)
    value = e @ e + ridge * np.sum((theta - prior) ** 2)
    foreseen = slope @ np.linalg.solve(J.T @ J + ridge * np.eye(len(theta)), slope)
    assert fitted.converged
    assert foreseen < 1e-4 * value  # what an undamped step would still gain
    assert_close(fitted.residual, np.sqrt(e @ e / len(samples.states)), rel=1e-9)


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
        slope = jacobian(spec, member, samples.states).T @ e.ravel() + RIDGE * (start - member)
        assert np.linalg.norm(slope) < 1e-2 * np.linalg.norm(start - member)


def test_a_fit_of_a_linear_model_is_the_ridge_solution_and_recovers_the_physics() -> None:
    spec = trial("arm", "oracle", 1, env={"horizon": 200})
    samples = uniform_samples(spec)
    fitted = fit_offline(spec, samples.states, samples.accelerations)
    truth = [getattr(spec.system, name) for name in spec.system.linear_parameters]
    assert_close(fitted.parameters, np.array(truth), abs=1e-2)
    assert fitted.loss < 1e-2


def test_fixed_parameters_of_a_linear_model_stay() -> None:
    model = {"name": "rff", "n_features": 30}
    learner = {"name": "recursive_least_squares"}
    spec = trial("pendulum", "random", 1, model=model, learner=learner, env={"horizon": 100})
    samples = uniform_samples(spec)
    fitted = fit_offline(spec, samples.states, samples.accelerations)
    fixed = spec.model.n_fixed_parameters(spec.system)
    assert np.array_equal(fitted.parameters[-fixed:], initial_weights(spec)[-fixed:])
    assert fitted.loss < 0.2 * grid_loss(spec, initial_weights(spec))


def test_a_larger_ridge_keeps_the_parameters_nearer_to_their_start() -> None:
    spec = small("pendulum")
    samples = uniform_samples(spec)
    start = initial_weights(spec)
    moved = [
        np.linalg.norm(
            fit_offline(spec, samples.states, samples.accelerations, ridge=ridge).parameters - start
        )
        for ridge in (1e-3, 1.0, 1e6)
    ]
    assert moved[0] > moved[1] > moved[2]
    assert moved[2] < 1e-2


def test_few_steps_are_said_not_to_have_converged() -> None:
    spec = small("pendulum")
    samples = uniform_samples(spec)
    fitted = fit_offline(spec, samples.states, samples.accelerations, max_steps=3)
    assert (fitted.steps, fitted.converged) == (3, False)


def test_the_loss_is_that_of_a_trial_after_its_last_step() -> None:
    for env in ("pendulum", "drifting_pendulum"):
        spec = small(env)
        result = dopt.run_trial(spec)
        assert_close(grid_loss(spec, result.parameters), result.final_loss, rel=1e-5)


@pytest.mark.parametrize("env", ["pendulum", "quadrotor", "drifting_pendulum"])
def test_recorded_samples_are_what_the_learner_was_given(env: str) -> None:
    from dopt.kernel.run import KernelTrial

    spec = small(env)
    running = KernelTrial(spec)
    running.advance(spec.system.horizon)
    samples = recorded_samples(spec.system, running.record.states, running.record.inputs)
    given = observed(running, running.done)
    assert_close(samples.accelerations, given, rel=1e-9, abs=1e-9)
    assert np.array_equal(samples.states, rerun(spec, [spec.system.horizon]).states[:-1])


def test_uniform_samples_fill_the_box_with_the_noise_of_the_trial() -> None:
    spec = small("cartpole", 400)
    system, samples = spec.system, uniform_samples(spec)
    for index, (low, high) in system.grid_box().items():
        column = samples.states[:, index]
        assert low <= column.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < column.max() <= high
    others = [i for i in range(system.n_states) if i not in system.grid_box()]
    assert not samples.states[:, others].any()
    noise = draw(spec).noise[:, list(system.learned_rows)] / system.dt
    assert_close(samples.accelerations - system.learned(samples.states), noise, abs=1e-12)
    other = uniform_samples(trial("cartpole", "uniform", 2, env={"horizon": 400}, model=SMALL))
    assert np.array_equal(samples.states, other.states)


def refused(words: str, spec: TrialSpec, samples: Samples, **settings: float) -> None:
    with pytest.raises(SpecificationError, match=words):
        fit_offline(spec, samples.states, samples.accelerations, **settings)  # type: ignore[arg-type]


def test_bad_input_gets_a_sentence() -> None:
    spec = small("pendulum")
    good = uniform_samples(spec)
    refused(r"ridge is 0, but a number above 0 is expected", spec, good, ridge=0)
    refused(r"ridge is nan", spec, good, ridge=float("nan"))
    refused(r"max_steps is 0, but at least 1", spec, good, max_steps=0)
    refused(r"states have the shape \(60, 1\)", spec, replace(good, states=good.states[:, :1]))
    refused(r"60 states and 59 accel", spec, replace(good, accelerations=good.accelerations[1:]))
    lost = good.states.copy()
    lost[7] = np.nan
    refused(r"states hold a number that is not finite", spec, replace(good, states=lost))
    process = trial("pendulum", "gaussian_process", 1)
    refused(r"model 'gaussian_process' has no offline fit, but 'mlp'", process, good)


def test_a_black_box_is_fitted_to_transitions_of_runs_of_its_own() -> None:
    pytest.importorskip("gymnasium")
    spec = TrialSpec.from_mapping(
        {
            "env": {"_target_": "tests.dopt.custom_environments.Point", "horizon": 40},
            "policy": {"name": "random"},
            "model": {"name": "mlp"},
            "learner": {"name": "adam_window"},
        }
    )
    samples = uniform_samples(spec)
    assert len(samples.states) == 40
    fitted = fit_offline(spec, samples.states, samples.accelerations)
    assert fitted.loss < grid_loss(spec, initial_weights(spec))
