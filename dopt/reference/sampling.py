"""Sampling planner over a batch of trials (:mod:`dopt.policies.icem`).

======  ==================================================  ==============
symbol  meaning                                             shape
======  ==================================================  ==============
P, K    plans, and inputs of a plan
N       rows of J along a path
U       upper triangular root, M⁻¹ = U Uᵀ                   (n, q, q)
W       directions of the parameters                        (n, q, g + s)
R       with Gᵀ = U⁻ᵀ Q R for the rows G at task states     (n, g, ·)
======  ==================================================  ==============
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.func import vmap

from dopt.algorithm import DOMAIN_MARGIN, SPREAD_KEPT, TIE_MARGIN, Score
from dopt.policies import ICEM
from dopt.policies.task_states import box_states, domain_box
from dopt.reference.state import BatchState


class SampledPlan:
    """Cross-entropy search of every trial; mean and elites are kept from step to step."""

    def __init__(self, batch: BatchState, policy: ICEM) -> None:
        self._batch, self._policy = batch, policy
        n, K, m = len(batch.theta), policy.segments, batch.system.n_inputs
        self._normals = batch.plans.view(n, -1, policy.iterations, policy.plans, K, m)
        self._mean = torch.zeros(n, K, m).to(batch.theta)
        self._elites = torch.zeros(n, policy.elites, K, m).to(batch.theta)
        self._rows = batch.learned.rows_at

    def plan(self, t: int) -> Tensor:
        """Return the inputs u_t, (n, m)."""
        policy, gamma = self._policy, self._batch.system.gamma
        W, R = self._directions(t)
        if t % policy.hold == 0:
            self._mean, self._elites = shifted(self._mean), shifted(self._elites)
        spread = torch.full_like(self._mean, gamma)
        inputs = self._elites
        values = self._values(t, inputs, W, R)
        if t == 1:
            values = torch.full_like(values, -torch.inf)
        normals = self._normals[:, t % self._normals.shape[1]]
        for iteration in range(policy.iterations):
            drawn = self._mean.unsqueeze(1) + spread.unsqueeze(1) * normals[:, iteration]
            drawn = gamma * drawn / torch.linalg.vector_norm(drawn, dim=-1, keepdim=True)
            inputs = torch.cat([inputs, drawn], dim=1)
            values = torch.cat([values, self._values(t, drawn, W, R)], dim=1)
            best = _rounded(values).argsort(dim=1, descending=True, stable=True)[:, : policy.elites]
            inputs = inputs.gather(1, best[..., None, None].expand(-1, -1, *inputs.shape[2:]))
            values = values.gather(1, best)
            mean, std = inputs.mean(dim=1), inputs.std(dim=1, correction=0)
            self._mean = SPREAD_KEPT * self._mean + (1.0 - SPREAD_KEPT) * mean
            spread = SPREAD_KEPT * spread + (1.0 - SPREAD_KEPT) * std
        self._elites = inputs
        found = values[:, :1] > -torch.inf
        chosen = torch.where(found, inputs[:, 0, 0], gamma * self._batch.ties[:, t])
        return torch.where(W.isfinite().flatten(1).all(dim=1, keepdim=True), chosen, torch.nan)

    def inform(self, t: int) -> None:
        """Take in step t: all that is known lies in θ and M."""

    def _directions(self, t: int) -> tuple[Tensor, Tensor]:
        """Return W and R; W is NaN where rounding has left M indefinite."""
        batch, count = self._batch, self._policy.task_count
        assert batch.information is not None
        U = batch.information.upper_root()
        q = U.shape[-1]
        random = batch.parameters[:, :q] / self._policy.samples**0.5
        if count == 0:
            return U @ random, U[:, :0, :0]
        pool = torch.tensor(box_states(batch.system)).to(U)
        states = pool[torch.arange(t * count, (t + 1) * count) % len(pool)]
        G = self._rows(batch.theta, states.expand(len(U), -1, -1)).flatten(1, 2)[..., :q]
        Q, R = torch.linalg.qr((G @ U).mT)
        return U @ torch.cat([Q, random - Q @ (Q.mT @ random)], dim=-1), R

    def _values(self, t: int, inputs: Tensor, W: Tensor, R: Tensor) -> Tensor:
        """Return the scores of plans, (n, P), given their inputs (n, P, K, m)."""
        policy, batch = self._policy, self._batch
        states, inside = self._paths(t, inputs)
        n, P, S = states.shape[:3]
        J = self._rows(batch.theta, states.flatten(1, 2))[..., : W.shape[1]]
        rows = (J @ W.unsqueeze(1)).view(n, P, S, -1, W.shape[-1])
        if policy.score in (Score.JOINT, Score.TASK):
            rows = rows * policy.stride**0.5
        rows = rows * self._weights(states)[..., None, None]
        values = vmap(vmap(_score(policy.score), (0, None)))(rows, R)
        return torch.where(inside & values.isfinite(), values, -torch.inf)

    def _weights(self, states: Tensor) -> Tensor:
        """Return the factors of the rows at states, (..., d), (...)."""
        batch = self._batch
        assert batch.held is not None
        domain = domain_box(batch.system, self._policy.domain)
        inside: Tensor = _domain_weights(torch.tensor(domain).to(states), states)
        weights: Tensor = inside * batch.held.noise_variance**-0.5
        return weights

    def _paths(self, t: int, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the states that count, (n, P, ·, d), and which paths stay in bounds, (n, P)."""
        batch, policy = self._batch, self._policy
        x = batch.states[:, t].unsqueeze(1).expand(-1, inputs.shape[1], -1)
        inside = torch.ones(x.shape[:2], dtype=torch.bool, device=x.device)
        kept = []
        for i in range(policy.lookahead // policy.stride * policy.stride):
            u = inputs[:, :, (t + i) // policy.hold - t // policy.hold]
            x = batch.learned.following(batch.theta, x, u)
            inside = inside & (x.abs() <= batch.system.state_limit).all(dim=-1)
            if (i + 1) % policy.stride == 0:
                kept.append(x)
        return torch.stack(kept, dim=2), inside


def _rounded(values: Tensor) -> Tensor:
    """Return scores, (n, P), in steps of a share of the largest: rounding must not choose."""
    finite = torch.where(values.isfinite(), values.abs(), 0.0).amax(dim=1, keepdim=True)
    step = torch.where(finite > 0, TIE_MARGIN * finite, 1.0)
    return torch.where(values.isfinite(), (values / step).round(), values)


def shifted(inputs: Tensor) -> Tensor:
    """Drop the first input of plans, (..., K, m), which was held to its end; repeat the last."""
    return torch.cat([inputs[..., 1:, :], inputs[..., -1:, :]], dim=-2)


def _domain_weights(domain: Tensor, states: Tensor) -> Tensor:
    """Return the factors of the rows at states, (..., d): 1 in the box, less farther from it."""
    turns = torch.where(domain[1] > 0, (states / domain[1]).round(), 0.0)
    excess = ((states - domain[1] * turns).abs() / domain[0] - 1.0).clamp(min=0.0)
    return torch.exp(-0.5 * (excess / DOMAIN_MARGIN).square().sum(dim=-1))


def _score(score: Score) -> Callable[[Tensor, Tensor], Tensor]:
    """Return the score of one path from J W, (states, r, g + s), and R.

    It is the mean over the horizons that end at one of the n states: the i-th adds its part (n - i)
    / n times.
    """

    def variance(rows: Tensor, R: Tensor) -> Tensor:  # noqa: ARG001  # one signature
        return _mean_over_horizons(rows.square().sum(dim=(1, 2)))

    def separate(rows: Tensor, R: Tensor) -> Tensor:  # noqa: ARG001  # one signature
        S = rows @ rows.mT
        return _mean_over_horizons(torch.linalg.slogdet(torch.eye(S.shape[-1]).to(S) + S)[1])

    def joint(rows: Tensor, R: Tensor) -> Tensor:  # noqa: ARG001  # one signature
        added = 2.0 * _factor(rows).diagonal().log()
        return _mean_over_horizons(added.view(rows.shape[:2]).sum(dim=1))

    def task(rows: Tensor, R: Tensor) -> Tensor:
        G = rows.flatten(0, 1)[:, : len(R)] @ R  # J M⁻¹ Gᵀ
        added = torch.linalg.solve_triangular(_factor(rows), G, upper=False).square().sum(dim=1)
        return _mean_over_horizons(added.view(rows.shape[:2]).sum(dim=1))

    chosen = {Score.TRACE: variance, Score.SUM: separate, Score.JOINT: joint, Score.TASK: task}
    return chosen[score]


def _factor(rows: Tensor) -> Tensor:
    """Return the Cholesky factor of I + J M⁻¹ Jᵀ for J W, (states, r, g + s)."""
    J = rows.flatten(0, 1)
    factor: Tensor = torch.linalg.cholesky_ex(torch.eye(len(J)).to(J) + J @ J.mT)[0]
    return factor


def _mean_over_horizons(added: Tensor) -> Tensor:
    """Return the mean of the sums up to each state of what the states, (n,), add."""
    return added.cumsum(dim=0).mean()
