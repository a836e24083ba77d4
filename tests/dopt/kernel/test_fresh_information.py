"""Information of all states at the present parameters: against dense sums."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch.func import jacrev, vmap

from dopt.errors import IncompatibleError
from dopt.kernel.linear_algebra import dense
from dopt.kernel.run import KernelTrial
from dopt.learning import LEARNERS
from dopt.policies import POLICIES, InformationPolicy
from dopt.policies.base import CompiledPolicy
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.close import assert_close
from tests.dopt.torch_models import model_of_one
from tests.dopt.trials import trial

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
    model = model_of_one(spec.system, spec.model)
    over_states = vmap(jacrev(model), in_dims=(None, 0))
    J: Array = over_states(torch.tensor(theta), torch.tensor(states)).flatten(0, 1).numpy()
    return J


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


def check_inverse(fast: KernelTrial, M: Array) -> None:
    """See that a trial holds M⁻¹, but for rounding."""
    assert_close(dense(fast.state.covariance) @ M, np.eye(len(M)), abs=1e-13 * np.linalg.cond(M))


@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm", "quadrotor"])
def test_the_matrix_is_that_of_all_states_at_the_present_parameters(env: str) -> None:
    fast = advanced(25, FRESH, env)
    M = summed(fast, 25)
    check_inverse(fast, M)
    old = advanced(25, {"information": "accumulated"}, env)
    assert not np.allclose(np.linalg.inv(dense(old.state.covariance)), M, rtol=0.1)


def test_between_two_sums_the_newest_rows_are_added() -> None:
    policy = FRESH | {"refresh_every": 4}
    M = summed(advanced(24, policy), 24)
    for steps in (25, 26):
        newest = advanced(steps, policy)
        J = rows(newest.spec, newest.state.theta, newest.record.states[steps - 1 : steps])
        M = M + J.T @ J
        check_inverse(newest, M)
    check_inverse(advanced(28, policy), summed(advanced(28, policy), 28))


@pytest.mark.parametrize("refresh_every", [1, 4])
def test_a_trial_that_is_cut_gives_the_numbers_of_one_call(refresh_every: int) -> None:
    policy = FRESH | {"refresh_every": refresh_every}
    whole, cut = advanced(30, policy), advanced(1, policy)
    for last in (2, 7, 8, 21, 30):
        cut.advance(last)
    assert np.array_equal(cut.record.inputs, whole.record.inputs)
    assert np.array_equal(cut.record.loss, whole.record.loss)
    assert np.array_equal(cut.state.theta, whole.state.theta)
    assert np.array_equal(dense(cut.state.covariance), dense(whole.state.covariance))


@pytest.mark.parametrize("policy", NETWORK_POLICIES)
def test_every_policy_plans_by_another_matrix(policy: str) -> None:
    plain = trial("arm", policy, 1, learner=NEWEST)
    fresh = trial("arm", policy, 1, policy=FRESH, learner=NEWEST)
    assert not np.array_equal(run_trial(fresh).inputs, run_trial(plain).inputs)


@pytest.mark.parametrize("policy", ["d_optimal", "exact"])
def test_a_prior_below_rounding_ends_the_trial_as_diverged(policy: str) -> None:
    given = FRESH | {"regularization": 1e-300}
    spec = trial("arm", policy, 1, policy=given)
    result = run_trial(spec)
    assert result.diverged_at is not None
    assert np.isnan(result.loss[result.diverged_at :]).all()


def test_stored_trials_keep_their_keys() -> None:
    plain = trial("arm", "d_optimal", 1)
    said = trial("arm", "d_optimal", 1, policy={"information": "accumulated", "refresh_every": 1})
    assert said.trial_key == plain.trial_key
    assert '"information"' not in plain.canonical_json()
    assert '"refresh_every"' not in plain.canonical_json()
    fresh = trial("arm", "d_optimal", 1, policy=FRESH)
    seldom = trial("arm", "d_optimal", 1, policy=FRESH | {"refresh_every": 5})
    assert len({spec.trial_key for spec in (plain, fresh, seldom)}) == 3
    for spec in (plain, fresh, seldom):
        assert TrialSpec.from_mapping(spec.to_mapping()) == spec


@pytest.mark.parametrize("form", ["dual", "sketch"])
def test_it_needs_the_primal_form(form: str) -> None:
    with pytest.raises(IncompatibleError, match=r"policy.information 'fresh' goes with policy"):
        trial("arm", "d_optimal", policy=FRESH | {"form": form})


@pytest.mark.parametrize(
    "learner", [name for name, one in LEARNERS.items() if one.updates_information]
)
def test_a_learner_that_updates_the_matrix_decides_about_it(learner: str) -> None:
    model = {"name": "mlp" if LEARNERS[learner].structure == "gradient" else "linear"}
    estimates = LEARNERS[learner].estimates_states
    env = {"measured_states": [0], "measurement_noise": [0.1]} if estimates else {}
    policy = FRESH | ({"regularization": 3.0} if estimates else {})
    with pytest.raises(
        IncompatibleError, match=r"^policy.information 'fresh' goes with .*: change"
    ):
        trial("arm", "d_optimal", policy=policy, learner={"name": learner}, model=model, env=env)


@pytest.mark.parametrize("model", ["linear", "linear_state", "rff"])
def test_it_is_refused_where_it_would_be_the_accumulated_one(model: str) -> None:
    least_squares = {"name": "recursive_least_squares"}
    with pytest.raises(
        IncompatibleError,
        match=rf"goes with model 'mlp', 'affine', 'black_box' or 'grey_box', but model '{model}'",
    ):
        trial(
            "mass_spring" if model == "linear_state" else "arm",
            "d_optimal",
            policy=FRESH,
            model={"name": model},
            learner=least_squares,
        )


def test_a_count_of_steps_says_nothing_without_it() -> None:
    with pytest.raises(IncompatibleError, match=r"policy.refresh_every 2 goes with policy.inform"):
        trial("arm", "d_optimal", policy={"refresh_every": 2})


def test_a_wide_network_holds_it_in_the_primal_form() -> None:
    wide = trial("arm", "d_optimal", policy=FRESH, model={"width": 64})
    assert wide.policy.chosen_form(10_000, 60) == "primal"  # type: ignore[attr-defined]
    assert trial("arm", "d_optimal").policy.chosen_form(10_000, 60) == "dual"  # type: ignore[attr-defined]


def own(**fields: object) -> TrialSpec:
    given = {"name": "numbered", "_target_": f"{__name__}.Numbered", **fields}
    mapping = trial("arm", "random", 1, learner=NEWEST).to_mapping()
    return TrialSpec.from_mapping({**mapping, "policy": given})


def test_the_numbers_of_a_users_compiled_policy_keep_their_places() -> None:
    for fields in ({}, FRESH, FRESH | {"refresh_every": 3}):
        spec = own(**fields)
        assert spec.policy.kernel_numbers(10, 1.0) == (1e-3, 0.25)
        result = run_trial(spec)
        assert result.inputs[1:] == pytest.approx(0.25 * spec.system.gamma)


def test_a_users_compiled_policy_has_fresh_information() -> None:
    fast = KernelTrial(own(information="fresh"))
    fast.advance(12)
    check_inverse(fast, summed(fast, 12))
    with pytest.raises(IncompatibleError, match=r"'fresh' goes with policy.form 'primal'"):
        own(information="fresh", form="dual")
