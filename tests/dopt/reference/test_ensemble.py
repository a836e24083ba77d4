"""The disagreement of an ensemble against plain loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dopt.errors import IncompatibleError, SpecificationError
from dopt.reference.batch import Lockstep, run_trials
from dopt.reference.ensemble import EnsemblePlan, disagreements
from tests.dopt.trials import trial


def started(env: str, steps: int, **policy: int) -> tuple[Lockstep, EnsemblePlan]:
    """Return a batch of two trials after some steps, and its plan."""
    batch = Lockstep([trial(env, "max", seed, policy=policy) for seed in (3, 4)])
    with torch.no_grad():
        for t in range(steps):
            batch.step(t)
    assert isinstance(batch.own_plan, EnsemblePlan)
    return batch, batch.own_plan


@pytest.mark.parametrize("lookahead", [1, 3])
@pytest.mark.parametrize("env", ["cartpole", "quadrotor"])
def test_the_value_is_the_variance_across_networks_where_the_input_leads(
    env: str, lookahead: int
) -> None:
    batch, plan = started(env, 4, ensemble=3, lookahead=lookahead)
    system, predict = batch.system, batch.specs[0].model.predict
    inputs = np.random.default_rng(0).normal(size=(3, system.n_inputs))
    found = disagreements(
        system, batch.model, plan.members, batch.states[:, 4], torch.tensor(inputs), lookahead
    )
    for i, members in enumerate(plan.members.detach().numpy()):
        for u, value in zip(inputs, found[i], strict=True):
            z, expected = batch.states[i, 4].numpy(), 0.0
            for _ in range(lookahead):
                mean = np.mean([predict(system, theta, z[None])[0] for theta in members], axis=0)
                step = np.array(system.known(tuple(z), tuple(u), system.parameters))
                step[list(system.learned_rows)] += mean
                z = z + system.dt * step
                expected += np.var(
                    [predict(system, theta, z[None])[0] for theta in members], axis=0
                ).sum()
            assert float(value) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("env", ["pendulum", "arm"])
def test_the_candidate_of_largest_disagreement_is_chosen(env: str) -> None:
    batch, plan = started(env, 6, candidates=8)
    gamma = batch.system.gamma
    angles = 2 * np.pi / 8 * np.arange(8)
    circle = gamma * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    tried = torch.tensor(circle if batch.system.n_inputs == 2 else [[gamma], [-gamma]])
    values = disagreements(batch.system, batch.model, plan.members, batch.states[:, 6], tried, 1)
    assert plan.plan(6) == pytest.approx(tried[values.argmax(dim=1)])
    assert values.std(dim=1).min() > 0.0


def test_the_first_network_is_the_trials_own_and_all_start_apart() -> None:
    batch, plan = started("arm", 0, ensemble=4)
    members = plan.members
    assert members.shape == (2, 4, batch.theta.shape[1])
    assert torch.equal(members[:, 0], batch.theta)
    flat = members.flatten(0, 1)
    assert len(torch.unique(flat, dim=0)) == 8
    assert flat.abs().amax() <= 1.0


def test_every_network_learns_what_the_trials_own_learns() -> None:
    """Started from the same weights they stay the same."""
    batch, plan = started("arm", 0, ensemble=3)
    with torch.no_grad():
        plan._others.copy_(batch.theta.repeat_interleave(2, dim=0))
        for t in range(5):
            batch.step(t)
    for k in (1, 2):
        assert plan.members[:, k].numpy() == pytest.approx(plan.members[:, 0].numpy(), rel=1e-9)


def test_the_other_networks_leave_the_learning_alone() -> None:
    """The same inputs lead to the same parameters as without an ensemble."""
    chosen = run_trials([trial("arm", "max", 3)])[0]
    plain = Lockstep([trial("arm", "random", 3)])
    plain.open_loop = torch.tensor(chosen.inputs)[None]
    with torch.no_grad():
        for t in range(len(chosen.inputs)):
            plain.step(t)
    assert np.array_equal(plain.theta[0].numpy(), chosen.parameters)


def test_a_batch_is_its_trials_one_by_one() -> None:
    specs = [trial("quadrotor", "max", seed, env={"horizon": 12}) for seed in range(3)]
    for spec, many in zip(specs, run_trials(specs), strict=True):
        one = run_trials([spec])[0]
        assert many.inputs == pytest.approx(one.inputs)
        assert many.loss == pytest.approx(one.loss, rel=1e-9)


def test_one_network_is_no_ensemble() -> None:
    with pytest.raises(SpecificationError, match=r"policy\.ensemble is 1.*at least 2"):
        trial("arm", "max", policy={"ensemble": 1})


def test_an_ensemble_is_one_of_networks() -> None:
    with pytest.raises(IncompatibleError, match="policy 'max' goes with model 'mlp'"):
        trial("arm", "max", model={"name": "rff"}, learner={"name": "recursive_least_squares"})
