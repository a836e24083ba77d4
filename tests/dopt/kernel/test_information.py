"""The inverse information that the kernel carries, against fresh inverses."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.func import jacrev, vmap

from dopt.kernel.linear_algebra import dense
from dopt.kernel.run import KernelTrial
from dopt.spec.trial import TrialSpec
from tests.close import assert_close
from tests.dopt.kernel.steps import run
from tests.dopt.torch_models import model_of_one
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
    product = dense(fast.state.covariance) @ M
    assert_close(product, np.eye(len(M)), abs=1e-9)


def test_information_never_decreases() -> None:
    fast = KernelTrial(trial("arm", "d_optimal", env={"horizon": 60}, model={"width": 6}))
    before = dense(fast.state.covariance)
    for t in range(60):
        fast.advance(t + 1)
        after = dense(fast.state.covariance)
        gained = np.linalg.eigvalsh(before - after)
        assert gained[0] >= -1e-11 * before.max()
        assert np.sum(gained > 1e-9 * gained[-1]) <= fast.spec.system.n_learned
        before = after


def test_two_thousand_steps_lose_no_definiteness_and_little_accuracy() -> None:
    steps = 2_000
    spec = trial(
        "pendulum", "d_optimal", 2, env={"horizon": steps}, policy={"regularization": 1e-3}
    )
    fast = KernelTrial(spec)
    parameters = run(fast, steps)
    J = jacobians(spec, parameters, fast.record.states[:-1]).reshape(steps, -1)
    M = 1e-3 * np.eye(J.shape[1]) + J.T @ J
    covariance = dense(fast.state.covariance)
    assert np.array_equal(covariance, covariance.T)
    values = np.linalg.eigvalsh(covariance)
    assert values[0] > 0.0
    assert values[-1] <= 1e3 * (1 + 1e-9)
    grid = spec.system.grid()
    probes = jacobians(spec, np.repeat(parameters[-1:], len(grid), axis=0), grid)[:, 0]
    carried = np.einsum("ni,ij,nj->n", probes, covariance, probes)
    fresh = np.einsum("ni,in->n", probes, np.linalg.solve(M, probes.T))
    assert carried == pytest.approx(fresh, rel=1e-8)
