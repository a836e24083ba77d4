"""Information matrices, Kalman filters and Gaussian processes against dense inverses."""

from __future__ import annotations

import dataclasses
import json
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.func import jacrev, vmap

from dopt.errors import IncompatibleError
from dopt.kernel.learners import filter_step, whiten
from dopt.kernel.linear_algebra import dense, initial_covariance
from dopt.kernel.run import KernelTrial
from dopt.learning import ExtendedKalman
from dopt.models import GaussianProcess
from dopt.models.gaussian_process import kernel
from dopt.policies import POLICIES, InformationPolicy
from dopt.policies.base import CompiledPolicy
from dopt.run import run_trial
from dopt.spec.config import FORM_VERSION
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.custom_networks import model_of_one
from tests.dopt.kernel.twin import check_inverse, interpreted, run
from tests.dopt.oracles.traces import observed
from tests.dopt.trials import trial


def jacobians(spec: TrialSpec, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return J of n pairs of parameters, (n, q), and states, (n, d): (n, r, q)."""
    rows = vmap(jacrev(model_of_one(spec.system, spec.model)))
    return rows(torch.tensor(theta), torch.tensor(x)).numpy()


@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm", "quadrotor"])
@pytest.mark.parametrize("policy", ["d_optimal", "oracle"])
def test_it_is_the_inverse_of_the_sum_of_all_rows(env: str, policy: str) -> None:
    spec = trial(env, policy, 1, env={"horizon": 37}, policy={"regularization": 1e-2})
    fast = KernelTrial(spec)
    parameters = run(fast, 37)
    J = jacobians(spec, parameters, fast.record.states[:-1]).reshape(-1, parameters.shape[1])
    M = 1e-2 * np.eye(J.shape[1]) + J.T @ J
    check_inverse(fast, M, 1e-9)


FRESH = {"information": "fresh"}
NEWEST = {"name": "adam", "learning_rate": 0.05}
"""A learner that moves the parameters far, so that old rows differ from fresh ones."""
NETWORK_POLICIES = [
    name
    for name, policy in POLICIES.items()
    if issubclass(policy, InformationPolicy) and name != "oracle"
]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Numbered(CompiledPolicy, InformationPolicy):
    """A compiled policy with a matrix M, whose input is the first number that it declares."""

    name: ClassVar[str] = "numbered"

    share: float = 0.25
    form: str = "primal"

    @staticmethod
    def plan(trial: Any, t: int, u: Array) -> None:  # noqa: ARG004
        u[:] = trial.algorithm.policy[1] * trial.plant.gamma

    def chosen_form(self, n_parameters: int, n_rows: int) -> str:  # noqa: ARG002
        return self.form


def rows(spec: TrialSpec, theta: Array, states: Array) -> Array:
    """Return J of all states, (n r, q)."""
    repeated = np.tile(theta, (len(states), 1))
    return jacobians(spec, repeated, states).reshape(-1, len(theta))


def advanced(steps: int, policy: dict[str, Any], env: str = "arm") -> KernelTrial:
    """Return a trial after some steps."""
    fast = KernelTrial(
        trial(env, "d_optimal", 2, policy=policy, learner=NEWEST, model={"width": 5})
    )
    fast.advance(steps)
    return fast


def summed(fast: KernelTrial, last: int) -> Array:
    """Return λI + Σ JᵀJ over the first states at the present parameters, (q, q)."""
    J = rows(fast.spec, fast.state.theta, fast.record.states[:last])
    M: Array = 1e-3 * np.eye(J.shape[1]) + J.T @ J
    return M


@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm", "quadrotor"])
def test_the_matrix_is_that_of_all_states_at_the_present_parameters(env: str) -> None:
    fast = advanced(25, FRESH, env)
    M = summed(fast, 25)
    check_inverse(fast, M, 1e-13 * np.linalg.cond(M))
    old = advanced(25, {"information": "accumulated"}, env)
    assert not np.allclose(np.linalg.inv(dense(old.state.covariance)), M, rtol=0.1)


def test_between_two_sums_the_newest_rows_are_added() -> None:
    policy = FRESH | {"refresh_every": 4}
    M = summed(advanced(24, policy), 24)
    for steps in (25, 26):
        newest = advanced(steps, policy)
        J = rows(newest.spec, newest.state.theta, newest.record.states[steps - 1 : steps])
        M = M + J.T @ J
        check_inverse(newest, M, 1e-13 * np.linalg.cond(M))
    M = summed(advanced(28, policy), 28)
    check_inverse(advanced(28, policy), M, 1e-13 * np.linalg.cond(M))


@pytest.mark.parametrize("policy", NETWORK_POLICIES)
def test_every_policy_plans_by_another_matrix(policy: str) -> None:
    plain = trial("arm", policy, 1, learner=NEWEST)
    fresh = trial("arm", policy, 1, policy=FRESH, learner=NEWEST)
    assert not np.array_equal(run_trial(fresh).inputs, run_trial(plain).inputs)


@pytest.mark.parametrize(
    ("policy", "sections"),
    [
        ("d_optimal", {"policy": FRESH | {"regularization": 1e-300}}),
        ("exact", {"policy": FRESH | {"regularization": 1e-300}}),
        ("random", {"learner": {"name": "gauss_newton", "regularization": 1e-300}}),
        ("random", {"learner": {"name": "ekf", "noise_variance": 1e-308}}),
    ],
)
def test_numbers_below_rounding_end_the_trial_as_diverged(policy: str, sections: Any) -> None:
    result = run_trial(trial("arm", policy, 1, **sections))
    assert result.diverged_at is not None
    assert result.final_loss is None
    assert np.isnan(result.loss[result.diverged_at :]).all()


EKF = {"name": "ekf"}
LEAST_SQUARES = {"learner": {"name": "recursive_least_squares"}}
OTHER_MODEL = r"goes with model 'mlp', 'affine', 'black_box' or 'grey_box', but model 'rff'"


@pytest.mark.parametrize(
    ("sections", "said"),
    [
        ({"policy": FRESH | {"form": "dual"}}, "policy.information 'fresh' goes with policy"),
        ({"policy": FRESH | {"form": "sketch"}}, "policy.information 'fresh' goes with policy"),
        ({"policy": FRESH, "learner": EKF}, "^policy.information 'fresh' goes with .*: change"),
        (
            {"policy": FRESH, "learner": {"name": "gauss_newton"}},
            "^policy.information 'fresh' goes with .*: change",
        ),
        ({"policy": FRESH, "model": {"name": "rff"}} | LEAST_SQUARES, OTHER_MODEL),
        ({"policy": {"refresh_every": 2}}, "policy.refresh_every 2 goes with policy.inform"),
    ],
)
def test_fresh_information_needs_a_primal_matrix_of_its_own(sections: Any, said: str) -> None:
    with pytest.raises(IncompatibleError, match=said):
        trial("arm", "d_optimal", **sections)


def test_fresh_information_and_filters_are_primal_at_any_size() -> None:
    wide = trial("arm", "d_optimal", policy=FRESH, model={"width": 64})
    assert wide.policy.chosen_form(10_000, 60) == "primal"  # type: ignore[attr-defined]
    assert trial("arm", "d_optimal").policy.chosen_form(10_000, 60) == "dual"  # type: ignore[attr-defined]
    spec = trial("arm", "d_optimal", learner=EKF, model={"width": 30}, env={"horizon": 3})
    assert KernelTrial(spec).state.covariance.size == 1202
    assert spec.config.memory > 2 * 8 * 1202**2


def test_auto_takes_no_form_that_is_too_large_and_the_key_says_so() -> None:
    """Where the cheapest form fits the key stays."""
    for width, form, version in ((64, "primal", None), (256, "sketch", FORM_VERSION)):
        given: dict[str, Any] = {"env": {"horizon": 100_000}, "model": {"width": width}}
        spec = trial("cartpole", "d_optimal", **given)
        assert spec.config.information is not None
        assert spec.config.information.form == form
        assert json.loads(spec.config_json).get("form_version") == version
        assert spec.config.memory < 2**30
        told = trial("cartpole", "d_optimal", policy={"form": "primal"}, **given)
        assert "form_version" not in told.config_json
    wide = trial("cartpole", "d_optimal", env={"horizon": 1000}, model={"width": 256})
    assert "form_version" not in wide.config_json  # in the dual form, as before


def own(**fields: object) -> TrialSpec:
    given = {"name": "numbered", "_target_": f"{__name__}.Numbered", **fields}
    mapping = trial("arm", "random", 1, learner=NEWEST).to_mapping()
    return TrialSpec.from_mapping({**mapping, "policy": given})


def test_a_users_compiled_policy_has_fresh_information() -> None:
    fast = KernelTrial(own(information="fresh"))
    fast.advance(12)
    M = summed(fast, 12)
    check_inverse(fast, M, 1e-13 * np.linalg.cond(M))
    with pytest.raises(IncompatibleError, match=r"'fresh' goes with policy.form 'primal'"):
        own(information="fresh", form="dual")


WEIGHED = {"name": "ekf", "underweighting": 2.0, "noise_variance": 0.1}
FADING = {"name": "ekf", "forgetting": 0.95, "noise_variance": 3.0, "regularization": 0.02}


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
    values = (observed(fast.spec, fast.record) - offset).ravel() / 2.0
    expected = np.linalg.lstsq(rows, np.concatenate([values, np.zeros(3)]))[0]
    assert fast.state.theta == pytest.approx(expected, rel=1e-7)


def test_an_underweighted_sample_has_the_variance_of_its_prediction_as_well() -> None:
    fast, parameters, J = filtered(WEIGHED | {"forgetting": 0.9})
    k, weight = ExtendedKalman(forgetting=0.9).renewal(J.shape[2], 1e-3)
    M = 1e-3 * np.eye(J.shape[2])
    targets = observed(fast.spec, fast.record)
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
    check_inverse(fast, M, 1e-7)


@given(st.integers(0, 1000), st.floats(0.01, 20.0), st.floats(1e-3, 10.0), st.floats(1e-6, 1e6))
def test_a_step_removes_at_most_a_share_of_an_error_and_of_its_variance(
    seed: int, underweighting: float, noise_variance: float, regularization: float
) -> None:
    """Of a linear model, with any λ; and nearly all that the plain filter does where λ is large."""
    rng = np.random.default_rng(seed)
    J, e, theta = rng.standard_normal((1, 5)), rng.standard_normal(1), np.zeros(5)
    covariance = initial_covariance(5, regularization, n_rows=1, n_planned=1)
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
    check_inverse(fast, M, 1e-7)


@given(st.integers(1, 400), st.floats(0.01, 0.9999), st.floats(1e-6, 1.0))
def test_the_renewal_holds_every_entry_between_half_and_twice_the_prior(
    n: int, forgetting: float, regularization: float
) -> None:
    k, weight = ExtendedKalman(forgetting=forgetting).renewal(n, regularization)
    assert ExtendedKalman().renewal(n, regularization) == (0, 0.0)  # which forgets nothing
    diagonal = np.full(n, regularization)
    for t in range(min(3 * -(-n // k), 2_000)):
        diagonal *= forgetting
        np.add.at(diagonal, np.arange(t * k, (t + 1) * k) % n, weight)
        assert diagonal.min() >= 0.5 * regularization * (1 - 1e-9)
        assert diagonal.max() <= 2.0 * regularization


def process(env: str, seed: int = 3, /, **fields: Any) -> TrialSpec:
    """Return a small trial that learns a Gaussian process."""
    return trial(env, "gaussian_process", seed, **fields)


def covariance(spec: TrialSpec, states: np.ndarray) -> np.ndarray:
    """Return K + σ²/dt I at states, (n, d)."""
    assert isinstance(spec.model, GaussianProcess)
    phi = spec.system.featurize(states)
    noise = spec.model.noise_variance(spec.system)
    return kernel(spec.model.fixed_numbers(spec.system), phi, phi) + noise * np.eye(len(states))


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
    fast = KernelTrial(process("pendulum", seed, env=sizes, model=model))
    fast.advance(40)
    K = covariance(fast.spec, fast.states[:40])
    factor = np.tril(fast.state.posterior.factors[0])
    np.testing.assert_allclose(factor, np.linalg.cholesky(K), rtol=0.0, atol=1e-8 * amplitude)
    np.testing.assert_allclose(factor @ factor.T, K, rtol=0.0, atol=1e-12 * amplitude**2)
