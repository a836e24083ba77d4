"""Closed form of greedy D-optimal inputs for linear systems, reference [7] of the paper."""

from __future__ import annotations

import torch
from torch import Tensor

from dopt.policies.greedy_linear import GreedyLinear
from dopt.reference.dynamics import input_matrix
from dopt.reference.models import features
from dopt.reference.planning import QuadraticProblem, d_optimal_inputs, predicted_states
from dopt.reference.state import BatchState


class GreedyLinearPlan:
    """uᵀQu - 2vᵀu with Q = BᵀΓ⁻¹B, v = -BᵀΓ⁻¹x̄ and Γ = λI + Σ x_s x_sᵀ, x in feature scales."""

    def __init__(self, batch: BatchState, policy: GreedyLinear) -> None:
        self._batch = batch
        prior = policy.regularization * torch.eye(batch.system.n_states).to(batch.theta)
        self._gram = prior.repeat(len(batch.theta), 1, 1)
        columns = input_matrix(batch.system, batch.states[:1, 0])[0]
        self._B = features(batch.system, columns.mT).mT

    def plan(self, t: int) -> Tensor:
        """Return the inputs u_t, (n, m)."""
        batch = self._batch
        bar = predicted_states(batch.learned, batch.theta, batch.states[:, t])
        center = features(batch.system, bar).unsqueeze(-1)
        solved = torch.linalg.solve(self._gram, self._B)
        v = -(solved.mT @ center).squeeze(-1)
        problem = QuadraticProblem(self._B.mT @ solved, v)
        return d_optimal_inputs(problem, batch.system.gamma, batch.ties[:, t])

    def inform(self, t: int) -> None:
        """Count the state at which step t was observed."""
        z = features(self._batch.system, self._batch.sampled_states[:, t])
        self._gram = self._gram + z.unsqueeze(-1) * z.unsqueeze(-2)
