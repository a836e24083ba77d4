"""Torch path: D-optimal plans, derivatives, information, learning, own modules."""

from __future__ import annotations

import functools
import pickle
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import jacrev, vmap

from dopt.errors import IncompatibleError, SpecificationError
from dopt.models import MLP
from dopt.policies import POLICIES
from dopt.randomness import draw
from dopt.reference import batch as reference
from dopt.reference.batch import Lockstep, run_trials
from dopt.reference.models import (
    SMALL,
    BatchInformation,
    BatchModel,
    d_optimal_inputs,
    gradients_and_changes,
    jacobian,
    model_function,
    network_function,
    planning_columns,
    quadratic_problem,
)
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from tests.dopt.custom_networks import Stack, for_one
from tests.dopt.trials import PAIRS, SMALL_SEARCHES, trial


class Situation(NamedTuple):
    """What a plan is made from, for one trial."""

    model: BatchModel
    theta: Tensor  # (q,)
    state: Tensor  # (d,)
    information: Tensor  # (q, q)


@functools.cache
def situation(
    spec: TrialSpec, seed: int, seen: int = 20, regularization: float = 1e-2
) -> Situation:
    """Return a situation after some states have been seen, for the model of a trial."""
    rng = torch.Generator().manual_seed(seed)
    system = spec.system
    model = model_function(system, spec.model)
    theta = torch.tensor(draw(spec.with_seed(seed)).weights)
    theta = theta + 0.1 * torch.rand(theta.shape, generator=rng, dtype=torch.float64)
    widths = torch.ones(system.n_states, dtype=torch.float64)
    widths[list(system.grid_indices)] = torch.tensor(system.grid_half_widths, dtype=torch.float64)
    states = widths * (2 * torch.rand(seen + 1, system.n_states, generator=rng).double() - 1)
    M = regularization * torch.eye(len(theta), dtype=torch.float64)
    if seen:
        J = vmap(jacrev(for_one(model)), (None, 0))(theta, states[1:]).flatten(0, 1)
        M = M + J.mT @ J
    return Situation(model, theta, states[0], M)


def step_from(spec: TrialSpec, now: Situation, u: Tensor) -> Tensor:
    """Return x(u) = x + dt f_θ(x, u), by the system's own equations, (d,)."""
    system = spec.system
    known = system.known(tuple(now.state), tuple(u), system.parameters)
    flow = torch.stack([torch.as_tensor(value, dtype=torch.float64) for value in known])
    rows = torch.zeros(system.n_states, system.n_learned, dtype=torch.float64)
    for k, row in enumerate(system.learned_rows):
        rows[row, k] = 1.0
    return now.state + system.dt * (flow + rows @ for_one(now.model)(now.theta, now.state))


def circle(radius: float, points: int) -> Tensor:
    """Return points on a circle, (points, 2)."""
    angles = torch.arange(points, dtype=torch.float64) * (2 * torch.pi / points)
    return radius * torch.stack([angles.cos(), angles.sin()], dim=-1)


def sphere(radius: float, dimensions: int) -> Tensor:
    """Return points on a sphere, (points, dimensions): both, evenly spread, or random ones."""
    if dimensions == 1:
        return torch.tensor([[radius], [-radius]], dtype=torch.float64)
    if dimensions == 2:
        return circle(radius, 3_600)
    rng = torch.Generator().manual_seed(0)
    points = torch.randn(20_000, dimensions, generator=rng, dtype=torch.float64)
    return radius * points / points.norm(dim=1, keepdim=True)


CASES = [(env, policy) for env, policy in PAIRS if policy in ("d_optimal", "oracle")]


def gradients(now: Situation, x: Tensor) -> Tensor:
    """Return J = ∂a/∂θ at n states, (n, r, q)."""
    return vmap(jacrev(for_one(now.model)), (None, 0))(now.theta, x)


@functools.cache
def pieces(spec: TrialSpec, seed: int) -> tuple[Tensor, Tensor]:
    """Return J, (r, q), and D B, (r, q, m), at x̄, both of D and B by central differences."""
    system, now = spec.system, situation(spec, seed)
    zero = torch.zeros(system.n_inputs, dtype=torch.float64)
    bar = step_from(spec, now, zero)
    at_bar = now._replace(state=bar)
    B = torch.stack(
        [(step_from(spec, at_bar, e) - step_from(spec, at_bar, -e)) / 2 for e in _axes(zero)], dim=1
    )
    step = 1e-5
    moved = step * _axes(bar)
    D = (gradients(now, bar + moved) - gradients(now, bar - moved)) / (2 * step)
    return gradients(now, bar[None])[0], D.permute(1, 2, 0) @ B


def _axes(like: Tensor) -> Tensor:
    return torch.eye(len(like), dtype=torch.float64)


class Solved(BatchInformation):
    """Matrices, (n, s, s), with which systems of equations are solved as they are."""

    def __init__(self, matrices: Tensor) -> None:
        self._matrices = matrices

    def solve(self, columns: Tensor) -> Tensor:
        return torch.linalg.solve(self._matrices, columns)


def solve(spec: TrialSpec, now: Situation, component: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return Q, v and the chosen input of the reference."""
    given = now.theta[None], now.state[None], torch.tensor([component])
    columns = planning_columns(spec.system, now.model, *given)
    problem = quadratic_problem(columns, Solved(now.information[None]))
    ties = torch.ones(1, spec.system.n_inputs, dtype=torch.float64)
    u = d_optimal_inputs(problem, spec.system.gamma, ties)
    return problem.Q[0], problem.v[0], u[0]


@pytest.mark.parametrize(("env", "policy"), CASES)
def test_the_problem_is_made_of_finite_differences_of_the_gradient(env: str, policy: str) -> None:
    spec = trial(env, policy)
    now = situation(spec, 0)
    inverse = torch.linalg.inv(now.information)
    for component, (g, DB) in enumerate(zip(*pieces(spec, 0), strict=True)):
        Q, v, _ = solve(spec, now, component)
        # Difference quotients of |v| v and of products lose half of the digits.
        scale = float((DB.mT @ inverse @ DB).abs().max() + (DB.mT @ inverse @ g).abs().max())
        assert torch.allclose(Q, DB.mT @ inverse @ DB, rtol=0.0, atol=1e-6 * scale)
        assert torch.allclose(v, -DB.mT @ inverse @ g, rtol=0.0, atol=1e-6 * scale)


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


class Noted(Stack):
    """Notes the dimensions of what it is called with."""

    called_with: list[int]

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        self.called_with.append(features.dim())
        return super().forward(features)


class Coupled(Noted):
    """What it makes of a point depends on the points beside it."""

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return super().forward(features) - features.mean()


@pytest.mark.parametrize(("kind", "at_once"), [(Noted, [2]), (Coupled, [1])])
def test_a_network_is_called_once_for_many_points_where_that_gives_the_same(
    kind: type[Noted], at_once: list[int]
) -> None:
    system, rng = SYSTEMS["pendulum"](), np.random.default_rng(1)
    module = kind(len(system.features), system.n_learned).double()
    module.called_with = []
    theta = torch.nn.utils.parameters_to_vector(module.parameters()).detach()[None]
    states = torch.tensor(rng.standard_normal((1, 7, system.n_states)))
    function = network_function(system, module)
    one_by_one = [function(theta, states[:, i : i + 1])[0, 0] for i in range(7)]
    for _ in range(2):  # the first time it is tried
        module.called_with.clear()
        many = function(theta, states)[0]
        assert torch.allclose(many, torch.stack(one_by_one), rtol=1e-12, atol=1e-13)
    assert module.called_with == at_once


SIZES = (7, SMALL, SMALL + 1, 150)


@pytest.mark.parametrize("size", SIZES)
def test_it_solves_as_a_fresh_factorisation(size: int) -> None:
    rng = torch.Generator().manual_seed(size)
    M = 0.1 * torch.eye(size, dtype=torch.float64).repeat(3, 1, 1)
    information = BatchInformation(0.1, M[:, 0])
    scales = torch.logspace(-1.5, 1.5, size, dtype=torch.float64)
    for step in range(48):
        rows = torch.randn(3, 1 + step % 3, size, generator=rng, dtype=torch.float64) * scales
        information.add(rows)
        M = M + rows.mT @ rows
        columns = torch.randn(3, size, 2, generator=rng, dtype=torch.float64)
        expected = torch.linalg.solve(M, columns)
        gap = (information.solve(columns) - expected).abs().max() / expected.abs().max()
        assert gap < 1e-8


@pytest.mark.parametrize("size", SIZES)
def test_a_trial_without_a_factor_has_no_solution_and_the_others_keep_theirs(size: int) -> None:
    information = BatchInformation(1.0, torch.zeros(2, size, dtype=torch.float64))
    rows, columns = torch.ones(2, 1, size).double(), torch.ones(2, size, 1).double()
    rows[0] = torch.nan
    information.add(rows)
    solved = information.solve(columns)
    assert solved[0].isnan().all()
    assert solved[1].isfinite().all()


def test_the_steps_are_those_of_the_optimizer_of_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    rule = {"name": "adam", "learning_rate": 0.03, "beta_1": 0.8, "beta_2": 0.95, "epsilon": 1e-6}
    specs = [trial("pendulum", "random", seed, learner=rule) for seed in (1, 2)]
    batch = reference.Lockstep(specs)
    slopes = torch.tensor(np.random.default_rng(0).normal(size=(30, *batch.theta.shape)))
    theirs, left = batch.theta.clone(), iter(slopes)
    monkeypatch.setattr(reference, "loss_gradient", lambda *_: next(left))
    optimizer = torch.optim.Adam([theirs], lr=0.03, betas=(0.8, 0.95), eps=1e-6, foreach=False)
    for t, slope in enumerate(slopes):
        batch.learn(t)
        theirs.grad = slope
        optimizer.step()
        assert torch.equal(batch.theta, theirs)


HERE = "tests.dopt.custom_networks"


def specification(
    target: str = "Stack", seed: int = 0, policy: str = "d_optimal", **arguments: Any
) -> TrialSpec:
    env = {"name": "cartpole", "horizon": 20, "grid_points": [3, 4, 3]}
    model = {"_target_": target if "." in target else f"{HERE}.{target}", **arguments}
    return TrialSpec.from_names(env, policy, model=model, seed=seed)


@pytest.mark.parametrize("env", SYSTEMS)
def test_a_network_predicts_what_the_shipped_one_does(env: str) -> None:
    model, system = specification(width=5, depth=3).model, SYSTEMS[env]()
    shipped, rng = MLP(width=5, depth=3), np.random.default_rng(0)
    theta = rng.normal(size=shipped.n_parameters(system))
    states = rng.normal(size=(7, system.n_states))
    assert model.n_parameters(system) == len(theta)
    predicted, expected = (one.predict(system, theta, states) for one in (model, shipped))
    np.testing.assert_allclose(predicted, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("policy", ["d_optimal", "uniform", "random"])
@torch.no_grad()
def test_a_trial_with_it_is_that_of_the_shipped_network(policy: str) -> None:
    spec = specification(policy=policy)
    shipped = TrialSpec.from_mapping(spec.to_mapping() | {"model": {"name": "mlp"}})
    batch, own = Lockstep([shipped]), run_trial(spec)
    batch.theta.copy_(Lockstep([spec]).theta)
    for t in range(spec.system.horizon):
        batch.step(t)
    np.testing.assert_allclose(own.states, batch.states[0].numpy(), rtol=1e-9)
    np.testing.assert_allclose(own.loss, batch.columns["loss"][0], rtol=1e-9)
    assert own.loss[-1] < own.loss[0]


@pytest.mark.parametrize("policy", POLICIES)
def test_every_policy_runs_with_it_or_says_why_not(policy: str) -> None:
    mapping = specification(policy="random", width=4).to_mapping()
    mapping["env"] = {"name": "pendulum", "horizon": 6, "grid_points": [4, 4]}
    given = {"name": policy, **SMALL_SEARCHES.get(policy, {})}
    try:
        spec = TrialSpec.from_mapping(mapping | {"policy": given})
    except IncompatibleError as error:
        assert str(error).startswith(f"policy '{policy}' ")  # noqa: PT017  # the rest runs
        return
    result = run_trial(spec)
    assert np.isfinite(result.loss).all()


def test_the_seed_alone_gives_the_initial_parameters() -> None:
    torch.manual_seed(1)
    first = Lockstep([specification(policy="random")]).theta
    torch.manual_seed(2)
    expected = torch.rand(1)
    torch.manual_seed(2)
    second = Lockstep([specification(policy="d_optimal")]).theta
    assert torch.equal(torch.rand(1), expected), "torch's own generator was touched"
    assert torch.equal(first, second)
    assert not torch.equal(first, Lockstep([specification(seed=1)]).theta)


def test_a_batch_holds_networks_with_initial_parameters_of_their_own() -> None:
    specs = [specification(seed=seed) for seed in range(2)]
    for together, spec in zip(run_trials(specs), specs, strict=True):
        np.testing.assert_allclose(together.states, run_trial(spec).states, rtol=1e-9)


def test_the_trial_comes_back_from_its_mapping_and_from_another_process() -> None:
    spec = specification(width=7)
    again = TrialSpec.from_mapping(spec.to_mapping())
    sent = pickle.loads(pickle.dumps(spec))
    assert again.trial_key == spec.trial_key == sent.trial_key
    assert spec.config.path == "reference"
    assert spec.columns()["model"] == "Stack"
    assert spec.trial_key != specification(width=8).trial_key


@pytest.mark.parametrize(
    ("target", "arguments", "sentence"),
    [
        ("nowhere.Net", {}, "cannot be imported"),
        ("Stakc", {}, "cannot be imported"),
        ("itertools", {}, "a class derived from torch.nn.Module is expected"),
        ("Stack", {"widht": 3}, "unexpected keyword argument 'widht'"),
        ("Stack", {"name": "mlp"}, "is called 'Stack'"),
        ("Stack", {"width": float("nan")}, "finite numbers, texts and lists"),
        ("Wide", {}, r"maps 4 features to shape \(2,\) is expected, and it gave: \(3,\)"),
        ("Empty", {}, "has parameters is expected"),
        ("Broken", {}, "no way from 4 features"),
    ],
)
def test_a_wrong_network_is_refused_in_a_sentence(
    target: str, arguments: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(SpecificationError, match=sentence) as caught:
        specification(target, **arguments)
    assert "model." in str(caught.value)
