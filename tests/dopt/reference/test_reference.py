"""Torch path: D-optimal plans, derivatives, information, learning, own modules."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from dopt.errors import IncompatibleError, SpecificationError
from dopt.models import MLP
from dopt.policies import POLICIES
from dopt.randomness import draw
from dopt.reference import batch as reference
from dopt.reference.batch import Lockstep, run_trials
from dopt.reference.models import (
    SMALL,
    BatchInformation,
    NetworkFunction,
    TrialInformation,
    gradients_and_changes,
    input_matrix,
    jacobian,
    planning_columns,
    predicted_states,
)
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from tests.dopt.custom_networks import Stack
from tests.dopt.trials import KNOWN_EFFECT, PAIRS, SMALL_SEARCHES, covering, trial


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

    function = NetworkFunction(SYSTEMS["pendulum"](), Partly())
    theta, phi = torch.ones(2, 6, dtype=torch.float64), torch.ones(2, 3, 3, dtype=torch.float64)
    J = jacobian(function, 1, theta, phi)
    assert torch.equal(J[..., 4:], torch.zeros_like(J[..., 4:]))
    assert bool((J[..., :4] != 0).all())


@pytest.mark.parametrize("env", sorted(SYSTEMS))
def test_one_trial_has_the_derivatives_of_a_batch(env: str) -> None:
    system = SYSTEMS[env]()
    r = system.n_learned
    torch.manual_seed(0)
    module = Stack(len(system.features), r).double()
    module.layers[0].requires_grad_(False)  # it is learned all the same
    function = NetworkFunction(system, module)
    q = sum(parameter.numel() for parameter in function._module.parameters())
    theta, x = 0.5 * torch.randn(2, q).double(), torch.randn(2, system.n_states).double()
    k, points = torch.tensor([r - 1, 0]), function.points(x[:, None])
    both = planning_columns(system, function, theta, x, k)
    rows = jacobian(function, r, theta, points)
    for i in range(2):
        bar = predicted_states(system, function, theta, x)[i : i + 1]
        moved = torch.func.jacfwd(function.points)(bar[0]) @ input_matrix(system, bar)[0]
        phi = function.points(bar)[0].detach()
        columns = function.gradient_and_changes(theta[i], phi, int(k[i]), moved.mT.detach())
        torch.testing.assert_close(columns, both[i], rtol=1e-9, atol=1e-11)
        found = jacobian(function, r, theta[i : i + 1], points[i : i + 1])
        torch.testing.assert_close(found[0], rows[i], rtol=1e-9, atol=1e-12)


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
    function = NetworkFunction(system, module)
    one_by_one = [function(theta, states[:, i : i + 1])[0, 0] for i in range(7)]
    for _ in range(2):  # the first time it is tried
        module.called_with.clear()
        many = function(theta, states)[0]
        assert torch.allclose(many, torch.stack(one_by_one), rtol=1e-12, atol=1e-13)
    assert module.called_with == at_once


class Tied(nn.Module):
    """Uses a layer twice, a matrix under two names, and counts its calls."""

    calls: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.inner = nn.Sequential(nn.Linear(3, 3), nn.Tanh())
        self.again = nn.Linear(3, 3)
        self.again.weight = self.inner[0].weight
        self.last = nn.Linear(3, 1)
        self.register_buffer("calls", torch.zeros(()))
        self.double()

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        self.calls += 1.0
        out: torch.Tensor = self.last(self.again(self.inner(self.inner(features))))
        return out


class Strict(Tied):
    """Has a normalised layer, and refuses what is not finite."""

    def __init__(self) -> None:
        super().__init__()
        self.last = nn.utils.parametrizations.weight_norm(self.last)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        if not bool(features.detach().isfinite().all()):
            raise RuntimeError("features are not finite")
        return super().forward(features)


@pytest.mark.parametrize(("kind", "n"), [(Strict, 1), (Tied, 2)])
def test_a_module_is_called_with_the_parameters_of_each_trial(kind: type[Tied], n: int) -> None:
    """torch.func.functional_call of another module is the oracle."""
    system, other = SYSTEMS["pendulum"](), kind()
    function = NetworkFunction(system, kind())
    sizes = {name: one.shape for name, one in other.named_parameters()}
    theta = torch.randn(n, sum(size.numel() for size in sizes.values())).double()
    x = torch.randn(n, 1, system.n_states).double()
    for i in range(n):
        parts = theta[i].split([size.numel() for size in sizes.values()])
        named = {one: part.view(sizes[one]) for one, part in zip(sizes, parts, strict=True)}
        features = torch.tensor(system.featurize(x[i].numpy()))[0]
        expected = torch.func.functional_call(other, named, (features,))
        assert torch.equal(function(theta[i : i + 1], x[i : i + 1])[0, 0], expected)
        torch.testing.assert_close(function(theta, x)[i, 0], expected, rtol=1e-12, atol=1e-13)


def test_two_trials_of_one_network_have_parameters_of_their_own() -> None:
    spec = specification()
    alone = run_trial(spec).parameters
    batches = [Lockstep([spec]), Lockstep([spec.with_seed(1)])]
    with torch.no_grad():
        for t in range(spec.system.horizon):
            for batch in batches:
                batch.step(t)
    np.testing.assert_array_equal(batches[0].theta[0].numpy(), alone)


def test_an_error_of_a_module_comes_through() -> None:
    system = SYSTEMS["pendulum"]()
    function = NetworkFunction(system, Strict())
    theta = torch.zeros(1, sum(one.numel() for one in function.parameters)).double()
    with pytest.raises(RuntimeError, match="not finite"):
        function(theta, torch.full((1, 1, system.n_states), torch.inf).double())


@pytest.mark.parametrize("friction", [50.0, 1000.0, 1e120])
def test_a_trial_that_diverges_ends_as_in_the_kernel(friction: float) -> None:
    """Numbers of Python raise where tensors and compiled code give infinity or NaN."""
    spec = trial("pendulum", "random", env={"friction": friction}).to_mapping()
    own = {"model": {"_target_": "tests.dopt.custom_networks.Stack"}, "path": "reference"}
    alone, compiled = (run_trial(TrialSpec.from_mapping(spec | one)) for one in (own, {}))
    assert alone.diverged_at == compiled.diverged_at
    assert alone.diverged_at is not None
    np.testing.assert_array_equal(alone.states, compiled.states)


SIZES = (7, SMALL, SMALL + 1, 150)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(("n", "kind"), [(3, BatchInformation), (1, TrialInformation)])
def test_it_solves_as_a_fresh_factorisation(
    size: int, n: int, kind: type[BatchInformation]
) -> None:
    rng = torch.Generator().manual_seed(size)
    M = 0.1 * torch.eye(size, dtype=torch.float64).repeat(n, 1, 1)
    information = kind(0.1, M[:, 0])
    scales = torch.logspace(-1.5, 1.5, size, dtype=torch.float64)
    for step in range(48):
        rows = torch.randn(n, 1 + step % 3, size, generator=rng, dtype=torch.float64) * scales
        information.add(rows)
        M = M + rows.mT @ rows
        columns = torch.randn(n, size, 2, generator=rng, dtype=torch.float64)
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
    alone = TrialInformation(1.0, torch.zeros(1, size, dtype=torch.float64))
    alone.add(rows[:1])
    assert alone.solve(columns[:1]).isnan().all()


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


class Residual(nn.Module):
    """A network of another kind: GELU units with a skip connection and a layer norm."""

    def __init__(self, n_in: int, n_out: int) -> None:
        super().__init__()
        self.lift = nn.Linear(n_in, 8, dtype=torch.float64)
        self.block = nn.Sequential(
            nn.LayerNorm(8, dtype=torch.float64), nn.Linear(8, 8, dtype=torch.float64), nn.GELU()
        )
        self.out = nn.Linear(8, n_out, dtype=torch.float64)

    def forward(self, phi: torch.Tensor) -> torch.Tensor:
        h = torch.relu(self.lift(phi))
        result: torch.Tensor = self.out(h + self.block(h))
        return result


@pytest.mark.parametrize("policy", POLICIES)
def test_every_policy_explores_any_module_or_says_why_not(policy: str) -> None:
    mapping = specification(f"{__name__}.Residual", policy="random").to_mapping()
    mapping["env"] = {"name": "pendulum", "horizon": 6, "grid_points": [4, 4]}
    given = {"name": policy, **SMALL_SEARCHES.get(policy, {})}
    try:
        spec = TrialSpec.from_mapping(mapping | {"policy": given})
    except IncompatibleError as error:
        assert str(error).startswith(f"policy '{policy}' ")  # noqa: PT017  # the rest runs
        return
    initial, result = draw(spec).weights, run_trial(spec)
    assert np.isfinite(result.loss).all()
    assert result.parameters.shape == initial.shape
    assert np.mean(result.parameters != initial) > 0.5  # units of a ReLU may be dead


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


LOCKSTEP = [pair for pair in PAIRS if pair[1] in ("random", "uniform", "d_optimal", "oracle")]


OWN: list[dict[str, Any]] = [
    *({"name": name} for name in KNOWN_EFFECT),
    {"integrator": "rk4"},
    {"name": "quadrotor", "integrator": "rk4", "width": 3},
    {"width": 3},
    {"name": "pendulum", "friction": 1000.0},  # which diverges
    {"policy": {"name": "uniform"}},
    {"policy": {"form": "sketch", "sketch_size": 120}},
]


@pytest.mark.parametrize(("env", "policy"), sorted({*covering(LOCKSTEP), *LOCKSTEP[:8]}))
def test_a_batch_is_its_trials_one_by_one(env: str, policy: str) -> None:
    check_one_by_one([trial(env, policy, seed, env={"horizon": 5}) for seed in range(3)])


@pytest.mark.parametrize("given", OWN, ids=str)
def test_a_network_alone_is_one_of_a_batch(given: dict[str, Any]) -> None:
    """A trial alone works with arrays, a batch with tensors."""
    model = {"_target_": f"{HERE}.Stack", "width": given.pop("width", 16)}
    policy = {"name": "d_optimal", **given.pop("policy", {})}
    env = {"name": "cartpole", "horizon": 12} | given
    mapping = TrialSpec.from_names(env, policy, model=model).to_mapping()
    check_one_by_one([TrialSpec.from_mapping(mapping | {"seed": seed}) for seed in range(3)])


def check_one_by_one(specs: list[TrialSpec]) -> None:
    together = run_trials(specs)
    for spec, many in zip(specs[1:], together[1:], strict=True):
        one, close = run_trials([spec])[0], np.testing.assert_allclose
        assert many.diverged_at == one.diverged_at
        close(many.inputs, one.inputs, rtol=0.0, atol=1e-9 * spec.system.gamma)
        close(many.states, one.states, rtol=1e-9, atol=1e-9)
        close(many.loss, one.loss, rtol=1e-9)
        close(many.parameters, one.parameters, rtol=1e-6, atol=1e-9)


def test_trials_of_two_configs_are_no_batch() -> None:
    with pytest.raises(SpecificationError, match="may differ in the seed alone"):
        run_trials([trial("arm", "random"), trial("arm", "uniform")])
