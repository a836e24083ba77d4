"""Learners of the reference against what they repeat."""

from __future__ import annotations

import numpy as np
import torch

from dopt.learning import Adam
from dopt.reference.learning import AdamLearner


def test_the_steps_are_those_of_the_optimizer_of_torch() -> None:
    rule = Adam(learning_rate=0.03, beta_1=0.8, beta_2=0.95, epsilon=1e-6)
    rng = np.random.default_rng(0)
    start, slopes = torch.tensor(rng.normal(size=(2, 5))), torch.tensor(rng.normal(size=(40, 2, 5)))
    ours, theirs = start.clone(), start.clone()
    learner = AdamLearner(rule, lambda theta, _: theta.unsqueeze(1), ours)
    learner._gradient = lambda _theta, slope, _targets: slope
    optimizer = torch.optim.Adam([theirs], lr=0.03, betas=(0.8, 0.95), eps=1e-6, foreach=False)
    for slope in slopes:
        learner._step(slope, slope)
        theirs.grad = slope
        optimizer.step()
        assert torch.equal(ours, theirs)
