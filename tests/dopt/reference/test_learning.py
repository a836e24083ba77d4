"""Adam of the torch path against the optimiser that it repeats."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dopt.reference import batch as reference
from tests.dopt.trials import trial


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
