"""Information of all states at the present parameters: against dense sums, and on both paths."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch.func import jacrev, vmap

from dopt.errors import IncompatibleError
from dopt.kernel.information.primal import dense
from dopt.kernel.run import KernelTrial
from dopt.reference.models import model_function
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.kernel.test_agreement import check_agreement
from tests.dopt.trials import trial

FRESH = {"information": "fresh"}
NEWEST = {"name": "adam", "learning_rate": 0.05}
"""A learner that moves the parameters far, so that old rows differ from fresh ones."""


def rows(spec: TrialSpec, theta: Array, states: Array) -> Array:
    """Return J of all states, (n r, q)."""
    model = model_function(spec.system, spec.model)
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


@pytest.mark.parametrize("env", ["pendulum", "arm"])
def test_the_matrix_is_that_of_all_states_at_the_present_parameters(env: str) -> None:
    fast = advanced(25, FRESH, env)
    J = rows(fast.spec, fast.state.theta, fast.record.states[:25])
    M = 1e-3 * np.eye(J.shape[1]) + J.T @ J
    assert dense(fast.state.covariance) @ M == pytest.approx(np.eye(len(M)), abs=1e-6)
    old = advanced(25, {"information": "accumulated"}, env)
    assert not np.allclose(np.linalg.inv(dense(old.state.covariance)), M, rtol=0.1)


def test_between_two_sums_the_newest_rows_are_added() -> None:
    policy = FRESH | {"refresh_every": 4}
    sums, after = advanced(24, policy), advanced(26, policy)
    J = rows(sums.spec, sums.state.theta, sums.record.states[:24])
    M = 1e-3 * np.eye(J.shape[1]) + J.T @ J
    for steps in (25, 26):
        newest = advanced(steps, policy)
        J = rows(newest.spec, newest.state.theta, newest.record.states[steps - 1 : steps])
        M = M + J.T @ J
    assert dense(after.state.covariance) @ M == pytest.approx(np.eye(len(M)), abs=1e-6)


@pytest.mark.parametrize("refresh_every", [1, 3])
@pytest.mark.parametrize("policy", ["d_optimal", "lookahead", "trace_linearized"])
@pytest.mark.parametrize("env", ["pendulum", "cartpole", "drifting_pendulum"])
def test_both_paths_plan_by_it(env: str, policy: str, refresh_every: int) -> None:
    given = FRESH | {"refresh_every": refresh_every}
    check_agreement(trial(env, policy, 3, env={"horizon": 9}, policy=given, learner=NEWEST))


def test_a_prior_below_rounding_ends_the_trial_as_diverged() -> None:
    policy = FRESH | {"regularization": 1e-300}
    assert run_trial(trial("arm", "d_optimal", 1, policy=policy)).diverged_at is not None


def test_it_is_the_accumulated_one_for_a_model_that_is_linear_in_its_parameters() -> None:
    fresh, old = (
        run_trial(trial("arm", "oracle", 1, policy={"information": information}))
        for information in ("fresh", "accumulated")
    )
    assert np.array_equal(fresh.inputs, old.inputs)


def test_stored_trials_keep_their_keys() -> None:
    plain = trial("arm", "d_optimal", 1)
    said = trial("arm", "d_optimal", 1, policy={"information": "accumulated", "refresh_every": 1})
    assert said.trial_key == plain.trial_key
    assert "information" not in plain.to_mapping()["policy"]
    fresh = trial("arm", "d_optimal", 1, policy=FRESH)
    assert fresh.trial_key != plain.trial_key
    assert TrialSpec.from_mapping(fresh.to_mapping()) == fresh


def test_it_needs_the_primal_form_and_a_matrix_of_the_policy() -> None:
    for form in ("dual", "sketch"):
        with pytest.raises(IncompatibleError, match=r"policy.information 'fresh' goes with policy"):
            trial("arm", "d_optimal", policy=FRESH | {"form": form})
    with pytest.raises(IncompatibleError, match="a learner that leaves M to the policy"):
        trial("arm", "d_optimal", policy=FRESH, learner={"name": "ekf"})


def test_a_wide_network_holds_it_in_the_primal_form() -> None:
    wide = trial("arm", "d_optimal", policy=FRESH, model={"width": 64})
    assert wide.policy.chosen_form(10_000, 60) == "primal"
    assert trial("arm", "d_optimal").policy.chosen_form(10_000, 60) == "dual"
