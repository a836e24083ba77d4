"""Adapter of custom policies and learners, which see one trial, to the batches of the reference."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from dopt.custom_planner import custom_planner
from dopt.learning.base import CustomLearner, check_update
from dopt.policies.base import Planner, check_choice
from dopt.randomness import stream
from dopt.reference.batch_trial_view import BatchTrialView
from dopt.reference.state import BatchState
from dopt.spec.trial import TrialSpec


def planners_for(specs: Sequence[TrialSpec]) -> list[Planner]:
    """Return the plan of each trial; none for a policy that this package plans in lockstep."""
    plans = (custom_planner(spec) for spec in specs)
    return [plan for plan in plans if plan is not None]


def planned_inputs(batch: BatchState, planners: Sequence[Planner], t: int) -> Tensor:
    """Return the inputs u_t, (n, m), of the trials' own plans; diverged ones get a random one.

    Raises
    ------
    SpecificationError
        If an input has the wrong shape or a norm above γ.
    """
    inputs = batch.open_loop[:, t].clone()
    for i in _alive(batch):
        chosen = np.asarray(planners[i].choose(BatchTrialView(batch, i, t)), dtype=np.float64)
        check_choice(batch.config.policy.name, chosen, t, batch.system)
        inputs[i] = torch.as_tensor(chosen).to(inputs)
    return inputs


def observe(batch: BatchState, planners: Sequence[Planner], t: int) -> None:
    """Let the plans take in what step t has brought."""
    if planners:
        for i in _alive(batch):
            planners[i].observe(BatchTrialView(batch, i, t + 1))


class OwnLearner:
    """The updates of a learner of one's own, one trial after the other."""

    def __init__(self, learner: CustomLearner, batch: BatchState) -> None:
        self._batch = batch
        self._updaters = [
            learner.updater(spec.system, stream(spec.seed, "updater")) for spec in batch.specs
        ]

    def learn(self, states: Tensor, targets: Tensor) -> None:  # noqa: ARG002  # the view has them
        """Update the parameters after states (n, t + 1, d).

        Raises
        ------
        SpecificationError
            If there are not as many parameters as before.
        """
        for i in _alive(self._batch):
            updated = self._updaters[i].update(BatchTrialView(self._batch, i, states.shape[1]))
            theta = np.asarray(updated, dtype=np.float64)
            check_update(self._batch.config.learner.name, theta, tuple(self._batch.theta[i].shape))
            self._batch.theta[i] = torch.as_tensor(theta).to(self._batch.theta)


def _alive(batch: BatchState) -> list[int]:
    diverged: list[bool] = batch.diverged[:, 0].tolist()
    return [i for i, ended in enumerate(diverged) if not ended]
