"""The Kalman filter as a learner: its gain, the one matrix that it shares, and its forgetting."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.func import jacrev

from dopt.errors import IncompatibleError
from dopt.kernel.learners.kalman import filter_step, whiten
from dopt.kernel.linear_algebra import PENDING_ROWS, dense
from dopt.kernel.run import KernelTrial
from dopt.kernel.structs import Covariance
from dopt.learning import ExtendedKalman
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from tests.dopt.kernel.calls import interpreted
from tests.dopt.kernel.steps import run
from tests.dopt.kernel.twin import observed
from tests.dopt.torch_models import model_of_one
from tests.dopt.trials import trial

EKF = {"name": "ekf"}
WEIGHED = {"name": "ekf", "underweighting": 2.0, "noise_variance": 0.1}
FADING = {"name": "ekf", "forgetting": 0.95, "noise_variance": 3.0, "regularization": 0.02}


def jacobians(spec: TrialSpec, before: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Return J at each state and the parameters before its learning step, (t, r, q)."""
    model = model_of_one(spec.system, spec.model)
    rows = [
        jacrev(model)(torch.tensor(p), torch.tensor(x)) for p, x in zip(before, states, strict=True)
    ]
    return torch.stack(rows).numpy()


def filtered(learner: dict[str, Any], policy: str = "d_optimal", steps: int = 25) -> Any:
    """Return a trial, the parameters before each step and after the last, and J of each step."""
    spec = trial("arm", policy, 2, env={"horizon": steps}, learner=learner, model={"width": 5})
    fast = KernelTrial(spec)
    initial = fast.state.theta.copy()
    parameters = np.concatenate([initial[None], run(fast, steps)])
    return fast, parameters, jacobians(spec, parameters[:-1], fast.record.states[:-1])


@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm", "quadrotor"])
def test_of_a_linear_model_it_is_recursive_least_squares(env: str) -> None:
    plain = run_trial(trial(env, "oracle", 4, env={"horizon": 60}))
    kalman = run_trial(trial(env, "oracle", 4, env={"horizon": 60}, learner=EKF))
    assert kalman.parameters == pytest.approx(plain.parameters, rel=1e-9)
    assert kalman.states == pytest.approx(plain.states, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("regularization", [1e-6, 1e-1])
def test_with_a_matrix_of_its_own_it_is_ridge_regression(regularization: float) -> None:
    given = {"regularization": regularization, "noise_variance": 4.0}
    spec = trial("cartpole", "random", 3, model={"name": "linear"}, learner=EKF | given)
    fast = KernelTrial(spec)
    fast.advance(30)
    states, zero = fast.record.states[:-1], np.zeros((30, 3))
    psi = jacobians(spec, zero, states).reshape(-1, 3)
    offset = spec.model.predict(spec.system, zero[0], states)
    rows = np.concatenate([psi / 2.0, np.sqrt(regularization) * np.eye(3)])
    values = (observed(fast, 30) - offset).ravel() / 2.0
    expected = np.linalg.lstsq(rows, np.concatenate([values, np.zeros(3)]))[0]
    assert fast.state.theta == pytest.approx(expected, rel=1e-7)


def test_planner_and_filter_hold_one_matrix_of_the_rows_before_each_step() -> None:
    fast, parameters, J = filtered(EKF | {"noise_variance": 2.0})
    M = 1e-3 * np.eye(J.shape[2])  # that of the policy
    targets = observed(fast, len(J))
    model = fast.spec.model
    for t, rows in enumerate(J):
        M = M + rows.T @ rows / 2.0
        state = fast.record.states[t : t + 1]
        residual = targets[t] - model.predict(fast.spec.system, parameters[t], state)[0]
        step = np.linalg.solve(M, rows.T @ residual / 2.0)
        assert parameters[t + 1] - parameters[t] == pytest.approx(step, rel=1e-5, abs=1e-7)
    assert dense(fast.state.covariance) @ M == pytest.approx(np.eye(len(M)), abs=1e-8)


def test_an_underweighted_sample_has_the_variance_of_its_prediction_as_well() -> None:
    fast, parameters, J = filtered(WEIGHED | {"forgetting": 0.9})
    k, weight = ExtendedKalman(forgetting=0.9).renewal(J.shape[2], 1e-3)
    M = 1e-3 * np.eye(J.shape[2])
    targets = observed(fast, len(J))
    for t, rows in enumerate(J):
        M = 0.9 * M
        for i in range(t * k, (t + 1) * k):
            M[i % len(M), i % len(M)] += weight
        predicted = rows @ np.linalg.solve(M, rows.T)
        gain = np.linalg.solve(M, rows.T) @ np.linalg.inv(0.1 * np.eye(2) + 3.0 * predicted)
        state = fast.record.states[t : t + 1]
        residual = targets[t] - fast.spec.model.predict(fast.spec.system, parameters[t], state)[0]
        step = gain @ residual
        assert parameters[t + 1] - parameters[t] == pytest.approx(step, rel=1e-5, abs=1e-7)
        M = M + rows.T @ np.linalg.solve(0.1 * np.eye(2) + 2.0 * predicted, rows)
    assert dense(fast.state.covariance) @ M == pytest.approx(np.eye(len(M)), abs=1e-7)


@given(
    st.integers(0, 1000),
    st.floats(0.01, 20.0),
    st.floats(1e-3, 10.0),
    st.floats(1e-6, 1e6),
)
def test_a_step_removes_at_most_a_share_of_an_error_and_of_its_variance(
    seed: int, underweighting: float, noise_variance: float, regularization: float
) -> None:
    """Of a linear model, with any λ; and nearly all that the plain filter does where λ is large."""
    rng = np.random.default_rng(seed)
    J, e, theta = rng.standard_normal((1, 5)), rng.standard_normal(1), np.zeros(5)
    covariance = Covariance(
        np.eye(5) / regularization, np.zeros((PENDING_ROWS, 5)), np.zeros(1, np.int64)
    )
    before = float(J[0] @ J[0]) / regularization
    rows, residuals = J.copy(), e.copy()
    interpreted(whiten)(covariance, rows, residuals, noise_variance, underweighting)
    interpreted(filter_step)(covariance, theta, rows, residuals)
    share = underweighting / (1.0 + underweighting)
    left = float((e - J @ theta)[0] / e[0])
    assert left >= share * (1 - 1e-9)
    assert float((J @ dense(covariance) @ J.T)[0, 0]) >= share * before * (1 - 1e-6)
    plain = noise_variance / (noise_variance + before)
    assert plain * (1 - 1e-9) <= left <= plain + underweighting * before / noise_variance + 1e-12


def test_of_a_linear_model_it_ends_where_recursive_least_squares_ends() -> None:
    """Samples count alike once their prediction is far more certain than they are."""
    given = {"name": "linear"}
    env = {"horizon": 400, "noise": 0.0}
    plain, weighed = (
        run_trial(trial("cartpole", "random", 3, env=env, model=given, learner=one)).parameters
        for one in (EKF, EKF | {"underweighting": 2.0})
    )
    assert np.array_equal(plain, weighed) is False
    assert weighed == pytest.approx(plain, rel=1e-2)


def test_the_policy_decides_about_the_prior_of_a_matrix_that_it_shares() -> None:
    learners = [EKF | {"regularization": value} for value in (1e-3, 1.0)]
    shared = [run_trial(trial("arm", "d_optimal", learner=one)) for one in learners]
    own = [run_trial(trial("arm", "random", learner=one)) for one in learners]
    assert np.array_equal(shared[0].parameters, shared[1].parameters)
    assert not np.array_equal(own[0].parameters, own[1].parameters)


@pytest.mark.parametrize("policy", ["d_optimal", "random"])
@pytest.mark.parametrize("forgetting", [0.3, 0.9, 0.99])
def test_what_fades_is_the_information_and_never_the_prior(forgetting: float, policy: str) -> None:
    learner = FADING | {"forgetting": forgetting}
    fast, _, J = filtered(learner, policy, 80)
    regularization = 1e-3 if policy == "d_optimal" else 0.02
    k, weight = ExtendedKalman(forgetting=forgetting).renewal(J.shape[2], regularization)
    M = regularization * np.eye(J.shape[2])
    for t, rows in enumerate(J):
        M = forgetting * M + rows.T @ rows / 3.0
        for i in range(t * k, (t + 1) * k):
            M[i % len(M), i % len(M)] += weight
        assert np.linalg.eigvalsh(M)[0] >= 0.5 * regularization * (1 - 1e-9)
    assert dense(fast.state.covariance) @ M == pytest.approx(np.eye(len(M)), abs=1e-7)


@given(st.integers(1, 400), st.floats(0.01, 0.9999), st.floats(1e-6, 1.0))
def test_the_renewal_holds_every_entry_between_half_and_twice_the_prior(
    n: int, forgetting: float, regularization: float
) -> None:
    k, weight = ExtendedKalman(forgetting=forgetting).renewal(n, regularization)
    diagonal = np.full(n, regularization)
    for t in range(min(3 * -(-n // k), 2_000)):
        diagonal *= forgetting
        np.add.at(diagonal, np.arange(t * k, (t + 1) * k) % n, weight)
        assert diagonal.min() >= 0.5 * regularization * (1 - 1e-9)
        assert diagonal.max() <= 2.0 * regularization


def test_a_filter_that_forgets_nothing_renews_nothing() -> None:
    assert ExtendedKalman().renewal(353, 1.0) == (0, 0.0)


def test_a_filter_needs_the_primal_form() -> None:
    with pytest.raises(IncompatibleError, match=r"learner 'ekf' goes with policy.form 'primal'"):
        trial("arm", "d_optimal", learner=EKF, policy={"form": "dual"})


def test_auto_is_primal_for_a_filter_of_any_size() -> None:
    spec = trial("arm", "d_optimal", learner=EKF, model={"width": 30}, env={"horizon": 3})
    fast = KernelTrial(spec)
    assert fast.state.covariance.upper.shape == (1202, 1202)
    assert spec.config.memory > 2 * 8 * 1202**2


def test_a_filter_that_loses_its_numbers_ends_the_trial() -> None:
    learner = EKF | {"noise_variance": 1e-308}
    result = run_trial(trial("pendulum", "random", learner=learner))
    assert result.diverged_at is not None
    assert result.final_loss is None
