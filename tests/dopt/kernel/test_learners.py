"""Learners, networks and noise of the kernel, against torch and dense least squares."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch.func import grad, vmap

from dopt.errors import IncompatibleError
from dopt.kernel.from_spec import points_of_trial, shared_points
from dopt.kernel.linear_algebra import PANEL, dense
from dopt.kernel.network import tanh
from dopt.kernel.run import KernelTrial
from dopt.policies import InformationPolicy, Search
from dopt.randomness import draw
from dopt.run import run_trial
from dopt.spec.config import CRITERION_VERSION
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.custom_networks import model_of_one
from tests.dopt.kernel import twin
from tests.dopt.oracles.traces import jacobian, model_step, observed
from tests.dopt.trials import trial

GAUSS_NEWTON = {"name": "gauss_newton"}


def advanced(
    learner: dict[str, Any],
    steps: int,
    env: str = "arm",
    policy: str = "d_optimal",
    width: int = 5,
    depth: int = 2,
) -> KernelTrial:
    """Return a trial after some steps."""
    shape = {"width": width, "depth": depth}
    spec = trial(env, policy, 2, env={"horizon": 40}, learner=learner, model=shape)
    fast = KernelTrial(spec)
    fast.advance(steps)
    return fast


def linearized(fast: KernelTrial, theta: Array, first: int = 0) -> tuple[Array, Array]:
    """Return J, (n r, q), and e, (n r,), of the samples from ``first`` on."""
    states = fast.record.states[first : fast.done]
    targets = observed(fast.spec, fast.record)[first : fast.done]
    errors = targets - fast.spec.model.predict(fast.spec.system, theta, states)
    return jacobian(fast.spec, theta, states).reshape(-1, len(theta)), errors.ravel()


def check_inverse(fast: KernelTrial, M: Array) -> None:
    """Check that a trial holds M⁻¹ up to rounding, or nothing where no policy reads it."""
    if isinstance(fast.spec.policy, InformationPolicy):
        twin.check_inverse(fast, M, min(1e-6, 1e-14 * np.linalg.cond(M)))
    else:
        assert fast.state.covariance.size == 0


SHAPES = [(1, 1), (19, 1), (4, 2), (7, 3)]
"""Widths and depths; the second network on the pendulum has three panels of parameters exactly."""


@pytest.mark.parametrize(("width", "depth"), SHAPES)
@pytest.mark.parametrize("policy", ["d_optimal", "random"])
@pytest.mark.parametrize(("env", "noise_variance"), [("pendulum", 0.1), ("arm", 1.0)])
def test_a_step_is_that_of_the_dense_normal_equations_and_leaves_their_matrix(
    env: str, noise_variance: float, policy: str, width: int, depth: int
) -> None:
    learner = GAUSS_NEWTON | {"noise_variance": noise_variance, "regularization": 0.02}
    before, after = (advanced(learner, steps, env, policy, width, depth) for steps in (24, 25))
    J, e = linearized(after, before.state.theta)
    assert J.shape[1] == 3 * PANEL or (env, width) != ("pendulum", 19)
    ridge = 1e-3 if policy == "d_optimal" else 0.02  # the policy's where it plans by M
    M = ridge * np.eye(J.shape[1]) + J.T @ J / noise_variance
    check_inverse(after, M)
    gradient = J.T @ e / noise_variance + ridge * (after.state.prior - before.state.theta)
    step, taken = np.linalg.solve(M, gradient), after.state.theta - before.state.theta
    share = taken @ step / (step @ step)
    assert min(abs(share * 2**k - 1.0) for k in range(7)) < 1e-6
    assert taken == pytest.approx(share * step, rel=1e-6, abs=1e-9)


def objective(fast: KernelTrial, theta: Array) -> float:
    """Return what a fit of all samples minimises, with the λ of the policy."""
    errors, distance = linearized(fast, theta)[1], theta - fast.state.prior
    return float(errors @ errors + 1e-3 * distance @ distance)


def test_a_fit_never_raises_what_it_minimises() -> None:
    fast, falls = advanced(GAUSS_NEWTON, 0), []
    for t in range(40):
        before = fast.state.theta.copy()
        fast.advance(t + 1)
        falls.append(objective(fast, before) - objective(fast, fast.state.theta))
    assert min(falls) > -1e-8
    assert np.median(falls) > 1e-6


def test_a_buffer_that_is_full_forgets_the_oldest_samples() -> None:
    before, after = (advanced(GAUSS_NEWTON | {"capacity": 6}, steps) for steps in (24, 25))
    J, _ = linearized(after, before.state.theta, 19)
    M = 1e-3 * np.eye(J.shape[1]) + J.T @ J
    check_inverse(after, M)


def test_between_two_fits_the_newest_sample_is_filtered() -> None:
    learner = GAUSS_NEWTON | {"refit_every": 4, "noise_variance": 0.5}
    before, after = advanced(learner, 22), advanced(learner, 23)  # fits at steps 0, 4, ... 20, 24
    J, e = linearized(after, before.state.theta, 22)
    M = np.linalg.inv(dense(before.state.covariance)) + J.T @ J / 0.5
    step = np.linalg.solve(M, J.T @ e / 0.5)
    assert after.state.theta - before.state.theta == pytest.approx(step, rel=1e-5, abs=1e-8)
    check_inverse(after, M)


def test_it_needs_the_primal_form_and_a_network() -> None:
    with pytest.raises(IncompatibleError, match=r"learner 'gauss_newton' goes with policy.form"):
        trial("arm", "d_optimal", learner=GAUSS_NEWTON, policy={"form": "dual"})
    with pytest.raises(IncompatibleError, match=r"learner 'gauss_newton' goes with model 'mlp'"):
        trial("arm", "oracle", learner=GAUSS_NEWTON)


REPLAY: dict[str, Any] = {"name": "adam_replay", "batch": 5, "steps": 3, "capacity": 7}
"""A buffer shorter than the trials, so that it goes round."""


def test_the_places_depend_on_the_seed_alone_and_move_no_other_draw() -> None:
    one, two = (draw(trial("arm", policy, 5, learner=REPLAY)) for policy in ("random", "uniform"))
    other = draw(trial("arm", "random", 6, learner=REPLAY))
    without = draw(trial("arm", "random", 5))
    assert np.array_equal(one.replay, two.replay)
    assert not np.array_equal(one.replay, other.replay)
    assert without.replay.size == 0
    for name in ("noise", "weights", "inputs", "components", "ties"):
        assert np.array_equal(getattr(one, name), getattr(without, name)), name


def test_every_place_that_holds_a_sample_is_drawn_alike() -> None:
    learner = REPLAY | {"batch": 4_000, "capacity": 10}
    places = draw(trial("pendulum", "random", learner=learner)).replay
    assert places.shape == (30, 3, 4_000)
    for t in (0, 3, 9, 29):
        filled = min(t + 1, 10)
        counts = np.bincount(places[t].ravel(), minlength=filled)
        assert len(counts) == filled
        assert counts * filled / 12_000 == pytest.approx(1.0, abs=0.2)


def test_a_step_follows_the_gradient_over_the_newest_samples_in_the_drawn_places() -> None:
    learner = REPLAY | {"beta_1": 0.0, "steps": 1}
    spec = trial("quadrotor", "random", 1, env={"horizon": 20}, learner=learner)
    fast, places = KernelTrial(spec), draw(spec).replay
    model = model_of_one(spec.system, spec.model)

    def loss(theta: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return (vmap(model, in_dims=(None, 0))(theta, x) - y).square().sum(-1).mean()

    kept: dict[int, int] = {}
    for t in range(20):
        before = torch.tensor(fast.state.theta)
        fast.advance(t + 1)
        kept[t % 7] = t
        times = [kept[place] for place in places[t, 0].tolist()]
        states, targets = map(torch.tensor, (fast.record.states, observed(spec, fast.record)))
        expected = grad(loss)(before, states[times], targets[times])
        scale = float(expected.abs().max())
        # Without momentum the first moment of Adam is the gradient itself.
        assert fast.state.moment_1 == pytest.approx(expected.numpy(), rel=0.0, abs=1e-9 * scale)


def test_memory_counts_the_features_at_the_evaluation_points() -> None:
    features = {"model": {"name": "rff"}, "learner": {"name": "recursive_least_squares"}}
    spec = trial("pendulum", "d_optimal", 3, env={"grid_points": [64, 64]}, **features)
    points = points_of_trial(shared_points(spec.config), KernelTrial(spec).trial.network)
    q = 200
    assert spec.config.memory >= points.basis.nbytes + 8 * q**2
    assert spec.config.largest_setting == "model.n_features"


EDGES = (0.0, -0.0, 5e-324, 1e-310, 1e-30, 19.99, 20.0, 20.01, 1e308, math.inf, math.nan)


def test_tanh_is_right_to_a_few_units_in_the_last_place_and_never_falls() -> None:
    rng = np.random.default_rng(0)
    small, unit = 10.0 ** rng.uniform(-320, 3, 4_000), rng.uniform(0, 1, 8_000)
    sizes = np.concatenate([small, unit, rng.uniform(0.0, 25.0, 8_000)])
    exact = np.array([math.tanh(x) for x in sizes])
    found = np.array([tanh(x) for x in sizes])
    assert np.abs(found - exact).max() <= 2 * np.spacing(1.0)
    assert np.all(np.abs(found - exact) <= 6 * np.spacing(exact))
    assert np.all(found <= 1.0)
    assert [tanh(-x) for x in sizes[::50]] == [-value for value in found[::50]]
    for x in (*EDGES, *(-x for x in EDGES)):
        assert tanh(x) == pytest.approx(math.tanh(x), rel=1e-15, nan_ok=True)
    for start in (0.0, 0.34, 0.35, 1.0, 5.0, 19.0):
        values = np.array([tanh(start + dx) for dx in np.linspace(-1e-3, 1e-3, 2_001)])
        assert np.all(np.diff(values) >= -2 * np.spacing(1.0))


SEARCHES = ["exact", "trace", "a_optimal", "e_optimal", "task", "lookahead"]


def noisy(policy: str, noise_variance: float) -> TrialSpec:
    learner = {"name": "ekf", "noise_variance": noise_variance}
    return trial("arm", policy, 2, env={"horizon": 40}, learner=learner)


def gains(policy: str, J: Array, C: Array, noise_variance: float) -> Array:
    """Return what the rows of each candidate add to log det M, or take of tr M⁻¹, C = M⁻¹."""
    CJ = C @ J.mT
    inner = noise_variance * np.eye(J.shape[1]) + J @ CJ
    if policy == "exact":
        return np.linalg.slogdet(inner / noise_variance)[1]
    found: Array = np.trace(CJ @ np.linalg.solve(inner, CJ.mT), axis1=1, axis2=2)
    return found


@pytest.mark.parametrize("noise_variance", [0.01, 30.0])
@pytest.mark.parametrize("policy", ["exact", "a_optimal"])
def test_the_input_is_the_best_for_the_matrix_itself(policy: str, noise_variance: float) -> None:
    fast, judged_otherwise = KernelTrial(noisy(policy, noise_variance)), 0
    assert isinstance(fast.spec.policy, Search)
    candidates = fast.spec.policy.compared_inputs(fast.spec.system)
    for t in range(2, 40, 2):
        fast.advance(t)
        theta, x = fast.state.theta, fast.record.states[t]
        states = np.array([model_step(fast.spec, theta, x, u) for u in candidates])
        J, C = jacobian(fast.spec, theta, states), dense(fast.state.covariance)
        found, unscaled = (gains(policy, J, C, rho) for rho in (noise_variance, 1.0))
        fast.advance(t + 1)
        taken = int(np.flatnonzero((candidates == fast.record.inputs[t]).all(axis=1))[0])
        assert found[taken] >= found.max() - 1e-6 * abs(found.max())
        judged_otherwise += unscaled[taken] < unscaled.max() * (1 - 1e-6)
    if policy != "exact":  # whose best candidate seldom depends on ρ
        assert judged_otherwise > 0


@pytest.mark.parametrize("policy", [*SEARCHES, "gradient"])
def test_such_trials_have_new_keys_and_no_others(policy: str) -> None:
    new, old = noisy(policy, 0.5), noisy(policy, 1.0)
    assert json.loads(new.config_json)["criterion_version"] == CRITERION_VERSION
    assert "criterion_version" not in old.config_json
    assert TrialSpec.from_mapping(new.to_mapping()) == new
    for other in ("d_optimal", "trace_linearized", "random"):
        assert "criterion_version" not in noisy(other, 0.5).config_json


def test_the_trace_is_judged_as_before() -> None:
    """Its argument is linear in 1/ρ; a power of four is divided by exactly."""
    for noise_variance in (0.25, 4.0):
        spec = noisy("trace", noise_variance)
        fast = KernelTrial(spec)
        unscaled = fast.trial.algorithm.search._replace(row_scale=1.0)
        fast.trial = fast.trial._replace(algorithm=fast.trial.algorithm._replace(search=unscaled))
        fast.advance(spec.system.horizon)
        assert np.array_equal(fast.record.inputs, run_trial(spec).inputs)
