"""Learning in the kernel against torch's gradient and optimiser, and against least squares."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.func import grad, vmap

from dopt.kernel.run import KernelTrial
from tests.dopt.kernel.twin import observed
from tests.dopt.torch_models import model_of_one
from tests.dopt.trials import trial


@pytest.mark.parametrize("depth", [1, 2, 3])
@pytest.mark.parametrize("window", [1, 4])
@pytest.mark.parametrize("env", ["pendulum", "quadrotor"])
def test_the_gradient_is_that_of_the_mean_square_over_the_newest_samples(
    env: str, window: int, depth: int
) -> None:
    learner = {"name": "adam", "beta_1": 0.0, "window": window}
    spec = trial(env, "random", 1, env={"horizon": 9}, learner=learner, model={"depth": depth})
    fast, model = KernelTrial(spec), model_of_one(spec.system, spec.model)

    def loss(theta: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return (vmap(model, in_dims=(None, 0))(theta, x) - y).square().sum(-1).mean()

    for t in range(9):
        before = torch.tensor(fast.state.theta)
        fast.advance(t + 1)
        states, targets = map(torch.tensor, (fast.record.states, observed(fast, t + 1)))
        newest = slice(max(0, t + 1 - window), t + 1)
        expected = grad(loss)(before, states[newest], targets[newest])
        # Without momentum the first moment of Adam is the gradient itself.
        scale = float(expected.abs().max())
        assert fast.state.moment_1 == pytest.approx(expected.numpy(), rel=0.0, abs=1e-9 * scale)


def test_steps_are_those_of_the_adam_of_torch() -> None:
    learner = {
        "name": "adam",
        "learning_rate": 3e-3,
        "beta_1": 0.8,
        "beta_2": 0.99,
        "epsilon": 1e-6,
    }
    spec = trial("arm", "random", 2, learner=learner)
    fast = KernelTrial(spec)
    parameter = torch.tensor(fast.state.theta)
    plain = torch.optim.Adam([parameter], lr=3e-3, betas=(0.8, 0.99), eps=1e-6)
    for t in range(30):
        moment = fast.state.moment_1.copy()
        fast.advance(t + 1)
        parameter.grad = torch.tensor((fast.state.moment_1 - 0.8 * moment) / 0.2)
        plain.step()
        assert fast.state.theta == pytest.approx(parameter.numpy(), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("regularization", [1e-6, 1e-1])
@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm", "quadrotor"])
def test_recursive_least_squares_is_ridge_regression(env: str, regularization: float) -> None:
    policy = {"regularization": regularization}
    spec = trial(env, "oracle", 3, policy=policy, env={"horizon": 60, "noise": 0.01})
    fast = KernelTrial(spec)
    fast.advance(60)
    system, x = spec.system, fast.record.states
    offset, *units = (
        np.stack(np.broadcast_arrays(*system.accelerations(tuple(x[:-1].T), form)), axis=-1)
        for form in system.linear_form
    )
    psi = np.stack([unit - offset for unit in units], axis=-1).reshape(-1, len(units))
    targets = observed(fast, 60) - offset
    ridge = np.sqrt(regularization) * np.eye(len(units))
    rows = np.concatenate([psi, ridge])
    values = np.concatenate([targets.ravel(), np.zeros(len(units))])
    expected = np.linalg.lstsq(rows, values)[0]
    assert fast.state.theta == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm", "quadrotor"])
def test_the_oracle_finds_the_true_parameters(env: str) -> None:
    spec = trial(env, "oracle", env={"horizon": 200, "noise": 1e-4})
    fast = KernelTrial(spec)
    fast.advance(200)
    truth = [getattr(spec.system, name) for name in spec.system.linear_parameters]
    assert fast.state.theta == pytest.approx(truth, abs=0.05)
    assert fast.record.loss[-1] < 0.05 * fast.record.loss[0]
