"""The torch reference: batches, modules of any kind, devices."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.func import vmap

from dopt.errors import SpecificationError
from dopt.kernel.run import KernelTrial
from dopt.randomness import draw
from dopt.reference.batch import Lockstep, run_trials
from dopt.reference.models import uniform_inputs
from dopt.spec.trial import TrialSpec
from tests.dopt.custom_networks import for_one
from tests.dopt.reference.test_reference import situation, sphere, step_from
from tests.dopt.trials import KNOWN_EFFECT, PAIRS, covering, trial


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


LOCKSTEP = [pair for pair in PAIRS if pair[1] in ("random", "uniform", "d_optimal", "oracle")]


@pytest.mark.parametrize(("env", "policy"), sorted({*covering(LOCKSTEP), *LOCKSTEP[:8]}))
def test_a_batch_is_its_trials_one_by_one(env: str, policy: str) -> None:
    specs = [trial(env, policy, seed, env={"horizon": 5}) for seed in range(3)]
    together = run_trials(specs)
    for spec, many in zip(specs[1:], together[1:], strict=True):
        one = run_trials([spec])[0]
        gamma = spec.system.gamma
        assert many.inputs == pytest.approx(one.inputs, rel=0.0, abs=1e-9 * gamma)
        assert many.states == pytest.approx(one.states, rel=1e-9, abs=1e-9)
        assert many.loss == pytest.approx(one.loss, rel=1e-9)
        assert many.parameters == pytest.approx(one.parameters, rel=1e-6, abs=1e-9)


def test_trials_of_two_configs_are_no_batch() -> None:
    with pytest.raises(SpecificationError, match="may differ in the seed alone"):
        run_trials([trial("arm", "random"), trial("arm", "uniform")])


@pytest.mark.parametrize("policy", ["d_optimal", "uniform", "random"])
def test_any_module_is_explored(policy: str) -> None:
    shipped = trial("arm", policy, env={"horizon": 25}, learner={"learning_rate": 2e-2})
    own = {"_target_": f"{Residual.__module__}.Residual"}
    spec = TrialSpec.from_mapping(shipped.to_mapping() | {"model": own, "path": None})
    initial, result = draw(spec).weights, run_trials([spec])[0]
    assert not result.diverged
    assert result.parameters.shape == initial.shape
    assert np.mean(result.parameters != initial) > 0.5  # units of a ReLU may be dead
    norms = np.linalg.norm(result.inputs, axis=1)
    if policy != "random":
        assert norms == pytest.approx(spec.system.gamma)


def test_information_is_the_prior_and_all_rows_after_each_learning_step() -> None:
    spec = trial("cartpole", "d_optimal", 2, env={"horizon": 6})
    batch = Lockstep([spec])
    expected = spec.policy.regularization * np.eye(batch.theta.shape[1])  # type: ignore[attr-defined]
    with torch.no_grad():
        for t in range(6):
            batch.step(t)
            rows = _differences(batch, batch.states[0, t])
            expected += rows.T @ rows
    assert batch.information is not None
    solved = batch.information.solve(torch.tensor(expected)[None])[0].numpy()
    np.testing.assert_allclose(solved, np.eye(len(expected)), rtol=0.0, atol=1e-5)


def _differences(batch: Lockstep, x: torch.Tensor) -> np.ndarray:
    """Return J, (r, q), by central differences of the model in each parameter."""
    model, theta, step = for_one(batch.model), batch.theta[0], 1e-5
    columns = [
        (model(theta + e, x) - model(theta - e, x)) / (2 * step)
        for e in step * torch.eye(len(theta), dtype=torch.float64)
    ]
    return torch.stack(columns, dim=1).numpy()


def test_the_kernel_and_the_reference_start_alike() -> None:
    spec = trial("arm", "d_optimal", 9)
    batch, fast = Lockstep([spec]), KernelTrial(spec)
    assert np.array_equal(batch.theta[0].numpy(), fast.state.theta)
    assert np.array_equal(batch.states[0, 0].numpy(), fast.record.states[0])


def spread(path: Tensor, following: Tensor) -> Tensor:
    """Return the sum of the distances from each of n next states to all states seen, (n,)."""
    return (following.unsqueeze(1) - path).norm(dim=-1).sum(dim=1)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("env", KNOWN_EFFECT)
def test_no_input_on_the_sphere_leads_farther(env: str, seed: int) -> None:
    spec = trial(env, "uniform")
    system = spec.system
    now = situation(spec, seed, seen=0)
    rng = torch.Generator().manual_seed(seed)
    steps = 0.05 * torch.randn(30, system.n_states, generator=rng, dtype=torch.float64)
    path = now.state + torch.flip(
        torch.cat([torch.zeros(1, system.n_states), steps.cumsum(0)]), [0]
    )
    chosen = uniform_inputs(system, now.model, now.theta[None], path[None], 8)[0]
    inputs = torch.cat([chosen[None], sphere(system.gamma, system.n_inputs)[::10]])
    found, *scan = spread(path, vmap(lambda u: step_from(spec, now, u))(inputs)).tolist()
    best, worst = max(scan), min(scan)
    assert chosen.norm().item() == pytest.approx(system.gamma, rel=1e-12)
    # Exact for one input; for two, what the ascent may lose of the whole range is small.
    margin = 1e-12 * best if system.n_inputs == 1 else 1e-3 * (best - worst)
    assert found >= best - margin
