"""Recorded functions: the same numbers as the functions themselves, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap
from torch.utils._pytree import tree_leaves

from dopt.reference import recorded as module
from dopt.reference.batch import run_trials
from dopt.reference.recorded import Recorded
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import trial


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Record at the second call."""
    monkeypatch.setattr(module, "FIRST_CALLS", 1)


def slopes(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return a gradient and a gradient of a gradient."""
    with torch.enable_grad():
        at = x.detach().requires_grad_()
        value = (torch.tanh(at @ y.mT) * at.sum(dim=1, keepdim=True).cos()).sum()
        (first,) = torch.autograd.grad(value, at, create_graph=True)
        (second,) = torch.autograd.grad((first * y[: len(x)]).sum(), at)
    return first.detach(), second


def in_place(x: Tensor, y: Tensor) -> Tensor:
    """Change a constant in place, by constants and by what varies."""
    out = torch.zeros(4, 3, dtype=x.dtype)
    out[1:3] += 1.0
    out[torch.tensor([0, 2])] = x[:2]
    out.add_(y.sum()).clamp_(max=2.0)
    fixed = x.new_ones(3)
    fixed[0] = 5.0
    return out * fixed


def views(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    left, right = x.mT.reshape(-1).split([5, len(x) * 3 - 5])
    return torch.cat([left.flip(0), right]).view(-1, 3)[1:], y.expand(2, -1, -1).mT


def shapes_in_place(x: Tensor, y: Tensor) -> Tensor:
    """Change shapes in place, as torch does itself where it multiplies by a vector."""
    product = (x @ y[0].unsqueeze(1)).squeeze_(1)
    return (x.mT * product).t_() + product.unsqueeze_(1)


def several_results(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    factor, failed = torch.linalg.cholesky_ex(x.mT @ x + torch.eye(3))
    largest, place = y.max(dim=0)
    return torch.where((failed > 0)[None], 0.0, factor), largest + place


LAYER = nn.Linear(3, 3, dtype=torch.float64)


def over_items(x: Tensor, y: Tensor) -> Tensor:
    weights = {"weight": y[:3] if len(y) >= 3 else y.new_ones(3, 3), "bias": y[0]}
    return vmap(lambda row: functional_call(LAYER, weights, (row,)))(x)


def nothing_that_varies(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    return torch.arange(3.0) * 2.0, x.new_zeros(2) + len(y)


FUNCTIONS = [
    slopes,
    in_place,
    views,
    shapes_in_place,
    several_results,
    over_items,
    nothing_that_varies,
]


def drawn(seed: int, n: int) -> tuple[Tensor, Tensor]:
    rng = np.random.default_rng(seed)
    return torch.tensor(rng.normal(size=(n, 3))), torch.tensor(rng.normal(size=(n + 1, 3)))


def check_equal(found: Any, expected: Any) -> None:
    for one, other in zip(tree_leaves(found), tree_leaves(expected), strict=True):
        assert one.shape == other.shape
        assert one.dtype == other.dtype
        assert torch.equal(one, other)
        assert not one.requires_grad


@torch.no_grad()
@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_recorded_function_gives_the_same_numbers(function: Callable[..., Any]) -> None:
    calls = []

    def counted(*arguments: Tensor) -> Any:
        calls.append(arguments)
        return function(*arguments)

    one = Recorded(counted)
    for n in (4, 6, 4):  # other shapes, and the first ones again
        for seed in range(5):
            x, y = drawn(seed, n)
            kept = x.clone(), y.clone()
            check_equal(one(x, y), function(x, y))
            assert torch.equal(x, kept[0])
            assert torch.equal(y, kept[1])
    assert len(calls) == 3 * 3  # once as it is, once to record it and once to compare


@torch.no_grad()
def test_what_is_read_in_place_may_change_there_and_may_move() -> None:
    one, (large, _) = Recorded(lambda x, y: x @ y.mT, in_place=1), drawn(0, 4)
    for seed in range(6):
        _, y = drawn(seed, 4)
        large += 1.0
        check_equal(one(large, y), large @ y.mT)
    assert one._recording is not None
    assert one._recording._inputs[0] is large
    for moved in (large.clone(), large.clone().mT.contiguous().mT, large[:, [2, 1, 0]]):
        for seed in range(6):
            _, y = drawn(seed, 4)
            check_equal(one(moved, y), moved @ y.mT)


@torch.no_grad()
def test_a_constant_is_computed_once() -> None:
    one = Recorded(lambda x, y: x + torch.arange(3.0).cos() * (y[0] * 0.0 + 1.0))
    for seed in range(3):
        one(*drawn(seed, 4))
    names = [str(call[0]) for call in one._recording._calls]  # type: ignore[union-attr]
    assert len(names) == 4  # not the cosine


@torch.no_grad()
@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: x if x.sum() > 0 else -y,
        lambda x, y: x * float(y[0, 0]),
        lambda x, y: x[y[: len(x), 0] > 0],
    ],
)
def test_a_function_that_looks_at_numbers_is_called_as_it_is(
    function: Callable[..., Tensor],
) -> None:
    one = Recorded(function)
    for seed in range(8):
        x, y = drawn(seed, 4)
        check_equal(one(x, y), function(x, y))


@torch.no_grad()
def test_a_sum_that_begins_with_a_number_of_its_own_does_not_go_on() -> None:
    def function(x: Tensor, y: Tensor) -> Tensor:
        total = torch.tensor(0.0, dtype=torch.float64)
        total += x.sum()
        return total * y

    one = Recorded(function)
    for seed in range(8):
        x, y = drawn(seed, 4)
        check_equal(one(x, y), function(x, y))


@torch.no_grad()
def test_a_function_that_computes_outside_of_torch_is_called_as_it_is() -> None:
    def function(x: Tensor, y: Tensor) -> Tensor:
        return x * torch.tensor(np.sin(y.numpy()[: len(x)]))

    one = Recorded(function)
    for seed in range(8):
        x, y = drawn(seed, 4)
        check_equal(one(x, y), function(x, y))


@torch.no_grad()
def test_a_function_that_draws_numbers_is_called_as_it_is() -> None:
    one = Recorded(lambda x: x + torch.rand(3))
    x = torch.zeros(3)
    assert len({float(one(x)[0]) for _ in range(6)}) == 6


@torch.no_grad()
def test_a_function_with_large_results_is_called_as_it_is() -> None:
    sizes = []

    def function(x: Tensor) -> Tensor:
        sizes.append(len(x))
        return (x[:, None] * x).sum(dim=1)

    one = Recorded(function)
    large = int(module.LARGEST["cpu"] ** 0.5 / 8) * 3 + 1
    for n in (10, large):
        for seed in range(4):
            x = torch.full((n,), float(seed), dtype=torch.float64)
            assert torch.equal(one(x), n * x**2)
    assert sizes == [10] * 3 + [large] * 4
    assert one._recording is not None
    assert not one._recording._calls


@torch.no_grad()
def test_a_function_is_recorded_once_it_is_called_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FIRST_CALLS", 4)
    calls = []
    one = Recorded(lambda x: calls.append(x) or x + 1.0)  # type: ignore[func-returns-value]
    for expected in (1, 2, 3, 4, 5, 6, 6, 6):
        one(torch.zeros(3))
        assert len(calls) == expected


def small(env: str, policy: str, /, **fields: Any) -> TrialSpec:
    return trial(env, policy, 2, **{"learner": {"name": "adam"}, **fields})


TRIALS = {
    "newest": small("cartpole", "d_optimal"),
    "window": small("arm", "d_optimal", learner={"name": "adam_window", "window": 5}),
    "replay": small("pendulum", "trace_linearized", learner={"name": "adam_replay"}),
    "filter": small("quadrotor", "d_optimal", learner={"name": "ekf"}),
    "fits": small("pendulum", "d_optimal", learner={"name": "gauss_newton", "refit_every": 7}),
    "sketch": small("cartpole", "d_optimal", policy={"form": "sketch", "sketch_size": 32}),
    "inputs": small("cartpole_unknown_gain", "d_optimal", model={"name": "black_box"}),
    "runge_kutta": small("pendulum", "d_optimal", env={"integrator": "rk4"}),
    "changing": small("drifting_pendulum", "d_optimal"),
    "oracle": trial("arm", "oracle"),
    "search": small("cartpole", "exact"),
    "fresh": small("pendulum", "d_optimal", policy={"information": "fresh", "refresh_every": 3}),
}


@pytest.mark.parametrize("name", TRIALS)
def test_a_trial_is_the_same_with_and_without_recordings(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    specs = [TRIALS[name].with_seed(seed) for seed in range(2)]
    found = run_trials(specs)
    monkeypatch.setitem(module.LARGEST, "cpu", 0)
    for one, other in zip(found, run_trials(specs), strict=True):
        for part in ("states", "inputs", "loss", "reachable_loss", "parameters"):
            np.testing.assert_array_equal(getattr(one, part), getattr(other, part))
