"""Plan of MAX: the input on whose predicted states an ensemble of networks disagrees most."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dopt.policies.disagreement import Disagreement
from dopt.randomness import stream
from dopt.reference.dynamics import flow
from dopt.reference.learning import learner_for
from dopt.reference.models import BatchModel
from dopt.reference.state import BatchState
from dopt.systems.base import System


class EnsemblePlan:
    """Networks beside each trial's own, and the choice by their disagreement."""

    def __init__(self, batch: BatchState, policy: Disagreement) -> None:
        self._batch, self._lookahead = batch, policy.lookahead
        self._inputs = torch.tensor(policy.compared_inputs(batch.system)).to(batch.theta)
        self._others = torch.tensor(_initial(batch, policy.ensemble - 1)).to(batch.theta)
        self._learner = learner_for(batch.config.learner, batch.model, self._others)

    @property
    def members(self) -> Tensor:
        """Parameters of all networks, (n, K, q), the trial's own first."""
        n, q = self._batch.theta.shape
        return torch.cat([self._batch.theta.unsqueeze(1), self._others.view(n, -1, q)], dim=1)

    def plan(self, t: int) -> Tensor:
        """Return the inputs u_t, (n, m)."""
        batch = self._batch
        values = disagreements(
            batch.system,
            batch.model,
            self.members,
            batch.states[:, t],
            self._inputs,
            self._lookahead,
        )
        return self._inputs[values.argmax(dim=1)]

    def inform(self, t: int) -> None:
        """Let the other networks take the learning step of time t."""
        batch = self._batch
        per_trial = len(self._others) // len(batch.theta)
        states, targets = (
            rows[:, : t + 1].repeat_interleave(per_trial, dim=0)
            for rows in (batch.sampled_states, batch.targets)
        )
        self._learner.learn(states, targets)


def disagreements(
    system: System,
    model: BatchModel,
    members: Tensor,
    x: Tensor,
    inputs: Tensor,
    lookahead: int,
) -> Tensor:
    """Return the value of each candidate in each trial, (n, C).

    Parameters
    ----------
    members : (n, K, q)
        Parameters of the networks.
    x : (n, d)
        Current states.
    inputs : (C, m)
        Candidates, each held over the ``lookahead`` steps.
    """
    n, K, q = members.shape

    def predict(z: Tensor) -> Tensor:
        """Return the accelerations of each network, (n, K, C, r), at states (n, C, d)."""
        states = z.unsqueeze(1).expand(n, K, *z.shape[1:]).flatten(0, 1)
        values: Tensor = model(members.reshape(n * K, q), states).unflatten(0, (n, K))
        return values

    z = x.unsqueeze(1).expand(-1, len(inputs), -1)
    values = torch.zeros(z.shape[:2]).to(x)
    predicted = predict(z)
    for _ in range(lookahead):
        z = z + system.dt * flow(system, z, inputs.expand(*z.shape[:2], -1), predicted.mean(dim=1))
        predicted = predict(z)
        values = values + predicted.var(dim=1, correction=0).sum(dim=-1)
    return values


def _initial(batch: BatchState, count: int) -> np.ndarray:
    """Return initial parameters of ``count`` more networks for each trial, (n · count, q)."""
    rngs = [stream(spec.seed, "planner") for spec in batch.specs]
    model, system = batch.config.model, batch.system
    return np.stack([model.initial_parameters(system, rng) for rng in rngs for _ in range(count)])
