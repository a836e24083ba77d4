"""Fresh information of what the reference alone runs: own networks, black boxes, own plans."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch.func import jacrev, vmap

from dopt.reference.batch import Lockstep, run_trials
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from tests.dopt.torch_models import for_one

NETWORK = "tests.dopt.custom_networks.Stack"
POINT = "tests.dopt.custom_environments.Point"
STEPS = 12


def specification(policy: str, /, **sections: Any) -> TrialSpec:
    mapping: dict[str, Any] = {
        "env": {"name": "cartpole", "horizon": 20, "grid_points": [3, 4, 3]},
        "policy": {"name": policy, "information": "fresh"},
        "model": {"name": "mlp", "width": 5},
        "learner": {"name": "adam", "learning_rate": 0.05},
    }
    return TrialSpec.from_mapping(mapping | sections)


def fresh(policy: str, **fields: Any) -> dict[str, Any]:
    return {"name": policy, "information": "fresh", **fields}


def check_sum(spec: TrialSpec, summed_at: int = STEPS) -> None:
    """See that M after some steps is the dense sum, with the newest rows since ``summed_at``."""
    batch = Lockstep([spec, spec.with_seed(7)])
    expected: list[torch.Tensor] = []
    rows = vmap(jacrev(for_one(batch.model)), in_dims=(None, 0))
    with torch.no_grad():
        for t in range(STEPS):
            batch.step(t)
            first = 0 if t + 1 == summed_at else t
            if t + 1 >= summed_at:
                thetas, states = batch.theta, batch.states[:, first : t + 1]
                J = [rows(theta, x).flatten(0, 1) for theta, x in zip(thetas, states, strict=True)]
                expected.append(torch.stack([one.T @ one for one in J]))
    assert batch.information is not None
    M = 1e-3 * torch.eye(expected[0].shape[-1]).double() + sum(expected)
    assert batch.information.matrix().numpy() == pytest.approx(M.numpy(), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("policy", ["d_optimal", "exact", "gradient"])
def test_of_a_network_of_a_users_own(policy: str) -> None:
    model = {"_target_": NETWORK, "width": 5}
    check_sum(specification(policy, model=model))
    check_sum(specification(policy, model=model, policy=fresh(policy, refresh_every=5)), 10)


def test_of_a_network_of_a_users_own_it_is_that_of_the_shipped_one() -> None:
    own = specification("d_optimal", model={"_target_": NETWORK, "width": 5})
    shipped, alone = Lockstep([specification("d_optimal")]), run_trial(own)
    shipped.theta.copy_(Lockstep([own]).theta)
    with torch.no_grad():
        for t in range(20):
            shipped.step(t)
    np.testing.assert_allclose(alone.inputs, shipped.inputs[0].numpy(), rtol=1e-9)
    assert np.array_equal(run_trial(own).inputs, alone.inputs)


def test_of_a_black_box() -> None:
    pytest.importorskip("gymnasium", reason="needs the extra gymnasium")
    env = {"_target_": POINT, "horizon": 30}
    spec = specification("d_optimal", env=env)
    check_sum(spec)
    accumulated = specification("d_optimal", env=env, policy={"name": "d_optimal"})
    assert not np.array_equal(run_trial(spec).inputs, run_trial(accumulated).inputs)
    together = run_trials([spec, spec.with_seed(1)])
    np.testing.assert_allclose(together[1].states, run_trial(spec.with_seed(1)).states, rtol=1e-9)
