"""Derivatives for many items at once against those of ``torch.func`` for one after the other."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.func import jacrev, jvp

from dopt.reference.models import (
    BatchModel,
    gradients_and_changes,
    jacobian,
    model_function,
    network_function,
)
from dopt.systems import SYSTEMS
from tests.dopt.torch_models import for_one
from tests.dopt.trials import trial

MODELS = ["mlp", "linear"]


def items(model: str, n: int, points: int) -> tuple[BatchModel, int, torch.Tensor, torch.Tensor]:
    """Return a model of the arm, its number of outputs, parameters (n, q) and points (n, N, ·)."""
    learner = "recursive_least_squares" if model == "linear" else "adam_window"
    policy = "oracle" if model == "linear" else "random"
    spec = trial("arm", policy, model={"name": model}, learner={"name": learner})
    rng = np.random.default_rng(1)
    theta = torch.tensor(rng.normal(size=(n, spec.model.n_parameters(spec.system))))
    x = torch.tensor(rng.normal(size=(n, points, spec.system.n_states)))
    return model_function(spec.system, spec.model), spec.system.n_learned, theta, x


@pytest.mark.parametrize("model", MODELS)
def test_rows_are_those_of_each_item(model: str) -> None:
    function, r, theta, points = items(model, 3, 4)
    found = jacobian(function, r, theta, points)
    for i in range(3):
        for j in range(4):
            one = jacrev(for_one(function))(theta[i], points[i, j])
            torch.testing.assert_close(found[i, j], one, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_changes_of_a_gradient_are_those_of_each_item(model: str) -> None:
    function, _, theta, points = items(model, 5, 1)
    components = torch.tensor([0, 1, 1, 0, 1])
    directions = torch.tensor(np.random.default_rng(2).normal(size=points[:, 0].shape))
    g, changes = gradients_and_changes(
        function,
        theta,
        points[:, 0],
        components,
        directions,
    )
    for i, k in enumerate(components.tolist()):

        def gradient(x: torch.Tensor, i: int = i, k: int = k) -> torch.Tensor:
            J: torch.Tensor = jacrev(for_one(function))(theta[i], x)
            return J[k]

        value, change = jvp(gradient, (points[i, 0],), (directions[i],))
        torch.testing.assert_close(g[i], value, rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(changes[i], change, rtol=1e-9, atol=1e-12)


def test_a_model_whose_slope_is_free_of_its_parameters_does_not_change_its_gradient() -> None:
    """A = x₁ + θ: neither the slope nor the gradient holds the other."""

    def model(theta: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        return x[..., :1] + theta.unsqueeze(1)

    one = torch.ones(2, 1, dtype=torch.float64)
    k = torch.zeros(2, dtype=torch.long)
    g, change = gradients_and_changes(model, one, one.expand(2, 3), k, one.expand(2, 3))
    assert torch.equal(g, one)
    assert torch.equal(change, torch.zeros_like(one))


def test_a_network_that_does_not_use_a_parameter_has_zeros_there() -> None:
    class Partly(torch.nn.Linear):
        def __init__(self) -> None:
            super().__init__(3, 1, dtype=torch.float64)
            self.unused = torch.nn.Parameter(torch.ones(2, dtype=torch.float64))

    function = network_function(SYSTEMS["pendulum"](), Partly())
    theta, x = torch.ones(2, 6, dtype=torch.float64), torch.ones(2, 3, 2, dtype=torch.float64)
    J = jacobian(function, 1, theta, x)
    assert torch.equal(J[..., 4:], torch.zeros_like(J[..., 4:]))
    assert bool((J[..., :4] != 0).all())
