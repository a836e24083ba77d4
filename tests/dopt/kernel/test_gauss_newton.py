"""Gauss-Newton on all samples: its normal equations, its steps and the matrix that it shares."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch.func import jacrev, vmap

from dopt.errors import IncompatibleError
from dopt.kernel.linear_algebra import BLOCK, dense
from dopt.kernel.run import KernelTrial
from dopt.policies import InformationPolicy
from dopt.run import run_trial
from dopt.types import Array
from tests.close import assert_close
from tests.dopt.kernel.twin import observed
from tests.dopt.torch_models import model_of_one
from tests.dopt.trials import trial

GAUSS_NEWTON = {"name": "gauss_newton"}
OTHER = {"name": "gauss_newton", "capacity": 6, "refit_every": 3, "steps": 2}
OTHER |= {"noise_variance": 0.2, "regularization": 0.02}


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
    model = model_of_one(fast.spec.system, fast.spec.model)
    states = torch.tensor(fast.record.states[first : fast.done])
    targets = torch.tensor(observed(fast, fast.done))[first:]
    J = vmap(jacrev(model), in_dims=(None, 0))(torch.tensor(theta), states).flatten(0, 1)
    values = vmap(model, in_dims=(None, 0))(torch.tensor(theta), states)
    return J.numpy(), (targets - values).flatten().numpy()


def check_inverse(fast: KernelTrial, M: Array) -> None:
    """See that a trial holds M⁻¹, but for rounding, or nothing where no policy reads it."""
    if not isinstance(fast.spec.policy, InformationPolicy):
        assert fast.state.covariance.upper.size == 0
        return
    assert_close(
        dense(fast.state.covariance) @ M, np.eye(len(M)), abs=min(1e-6, 1e-14 * np.linalg.cond(M))
    )


SHAPES = [(1, 1), (19, 1), (4, 2), (7, 3)]
"""Widths and depths; the second network on the pendulum has two blocks of parameters exactly."""


@pytest.mark.parametrize(("width", "depth"), SHAPES)
@pytest.mark.parametrize("policy", ["d_optimal", "random"])
@pytest.mark.parametrize(("env", "noise_variance"), [("pendulum", 0.1), ("arm", 1.0)])
def test_a_step_is_that_of_the_dense_normal_equations_and_leaves_their_matrix(
    env: str, noise_variance: float, policy: str, width: int, depth: int
) -> None:
    learner = GAUSS_NEWTON | {"noise_variance": noise_variance, "regularization": 0.02}
    before, after = (advanced(learner, steps, env, policy, width, depth) for steps in (24, 25))
    J, e = linearized(after, before.state.theta)
    assert J.shape[1] == 2 * BLOCK or (env, width) != ("pendulum", 19)
    ridge = 1e-3 if policy == "d_optimal" else 0.02  # that of the policy where it plans by M
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


def test_many_steps_of_a_fit_end_at_a_minimum() -> None:
    fast = advanced(GAUSS_NEWTON | {"steps": 100}, 12)
    theta = fast.state.theta
    J, e = linearized(fast, theta)
    slope = J.T @ e + 1e-3 * (fast.state.prior - theta)
    observations = observed(fast, fast.done).ravel()
    assert np.abs(slope).max() < 1e-5 * np.abs(J.T @ observations).max()


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


@pytest.mark.parametrize("env", ["pendulum", "quadrotor"])
def test_it_explains_all_samples_better_than_the_window(env: str) -> None:
    errors = []
    for learner in (GAUSS_NEWTON, {"name": "adam_window"}):
        fast = advanced(learner, 40, env, "random")
        errors.append(np.sqrt(np.mean(linearized(fast, fast.state.theta)[1] ** 2)))
    assert errors[0] < 0.1 * errors[1]


def test_a_prior_below_rounding_ends_the_trial_as_diverged() -> None:
    spec = trial("arm", "random", 1, learner=GAUSS_NEWTON | {"regularization": 1e-300})
    result = run_trial(spec)
    assert result.diverged_at is not None
    assert np.isnan(result.loss[result.diverged_at :]).all()


def test_it_needs_the_primal_form_and_a_network() -> None:
    with pytest.raises(IncompatibleError, match=r"learner 'gauss_newton' goes with policy.form"):
        trial("arm", "d_optimal", learner=GAUSS_NEWTON, policy={"form": "dual"})
    with pytest.raises(IncompatibleError, match=r"learner 'gauss_newton' goes with model 'mlp'"):
        trial("arm", "oracle", learner=GAUSS_NEWTON)
