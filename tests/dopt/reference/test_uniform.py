from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.func import vmap

from dopt.reference.planning import uniform_inputs
from tests.dopt.reference.batch import situation, sphere, step_from
from tests.dopt.trials import KNOWN_EFFECT, trial


def spread(path: Tensor, following: Tensor) -> Tensor:
    """Return the sum of the distances from each of n next states to all states seen, (n,)."""
    return (following.unsqueeze(1) - path).norm(dim=-1).sum(dim=1)


@pytest.mark.parametrize("seed", range(4))
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
