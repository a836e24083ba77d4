"""Inputs that keep the states of a plant within bounds, for a batch of trials (:mod:`dopt.limits`).

The rules are those of :mod:`dopt.kernel.limits`. Here the paths of all inputs that may be chosen,
errors and backup inputs are predicted together.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dopt.algorithm import NEWEST_ERRORS, TIE_MARGIN
from dopt.limits import Limits
from dopt.policies import ICEM, InformationPolicy, Search
from dopt.reference.dynamics import next_states
from dopt.reference.joint_kalman import JointKalmanLearner
from dopt.reference.learning import BatchLearner
from dopt.reference.planning import predicted_states
from dopt.reference.state import BatchState


class BatchLimits:
    """Limits of a batch of trials, and what they know of the errors of its models.

    The learner says how uncertain its estimates are where it estimates states.
    """

    def __init__(
        self, batch: BatchState, limits: Limits, learner: BatchLearner | JointKalmanLearner
    ) -> None:
        system, n = batch.system, len(batch.specs)
        self._batch, self._limits = batch, limits
        self._lower, self._upper = batch.tensor(limits.of_states(system)).unbind(-1)
        self._input_lower, self._input_upper = batch.tensor(limits.of_inputs(system)).unbind(-1)
        self._change = batch.tensor(limits.changes(system))
        self._bounded = bool((self._lower.isfinite() | self._upper.isfinite()).any())
        axes = system.gamma * torch.eye(system.n_inputs).to(batch.theta)
        signed = torch.stack([axes, -axes], dim=1).flatten(0, 1)
        self._backups = torch.cat([signed, torch.zeros_like(axes[:1])])
        self._scale = batch.theta.new_zeros(n, system.n_learned)
        self._last_input, self._gamma = torch.zeros_like(batch.inputs[:, 0]), system.gamma
        self._variances = torch.zeros_like(self._scale), torch.zeros_like(self._scale)
        policy = batch.config.policy
        searches = isinstance(policy, (Search, ICEM))
        self._has_information = isinstance(policy, InformationPolicy) and not searches
        self._filter = learner if isinstance(learner, JointKalmanLearner) else None

    def limited(self, t: int, u: Tensor) -> Tensor:
        """Return inputs, (n, m), that heed the limits in the place of u_t, (n, m)."""
        before = self._input_before()
        moved = self._within(before, u)
        if self._bounded:
            moved = self._kept(t, before, moved)
        self._last_input = torch.where(u.isfinite().all(dim=1, keepdim=True), moved, u)
        return self._last_input

    def _input_before(self) -> Tensor:
        """Return the last inputs, (n, m), moved into their box and the sphere ‖u‖ ≤ γ."""
        before = torch.clamp(self._last_input, self._input_lower, self._input_upper)
        norm, gamma = torch.linalg.vector_norm(before, dim=1, keepdim=True), self._gamma
        return torch.where(norm > gamma, before * (gamma / norm), before)

    def note_error(self, t: int, sampled: Tensor) -> None:
        """Take the errors of the accelerations observed at step t, before they are learned.

        ``sampled``, (n, ·), are the points at which they were observed. Of estimated states there
        are none: the filter knows how uncertain they are.
        """
        batch = self._batch
        self._last_input = batch.inputs[:, t]
        if self._filter is not None:
            return
        value = batch.model(batch.theta, sampled.unsqueeze(1)).squeeze(1)
        square = (batch.targets[:, t] - value).square() / (1 + self._variances[0])
        self._scale += max(1 / (t + 1), 1 / NEWEST_ERRORS) * (square - self._scale)

    def _within(self, before: Tensor, u: Tensor) -> Tensor:
        """Move inputs, (..., m), into their box, and then towards those before them."""
        u = torch.clamp(u, self._input_lower, self._input_upper)
        change = (u - before).abs()
        share = torch.where(change > self._change, self._change / change, 1.0)
        share = share.amin(dim=-1, keepdim=True)
        return torch.where(share < 1.0, before + share * (u - before), u)

    def _kept(self, t: int, before: Tensor, u: Tensor) -> Tensor:
        """Return the first of the inputs that keeps the states within bounds, or the best."""
        n, m = u.shape
        others = self._backups.expand(n, -1, m)
        tried = torch.cat([u.unsqueeze(1), -u.unsqueeze(1), others], dim=1)
        tried = self._within(before.unsqueeze(1), tried)
        tried[:, 0] = u
        excess = self._excess(self._batch.states[:, t], tried, self._error_bounds(t))
        chosen, best = u, excess[:, 0]
        for i in range(1, tried.shape[1]):
            better = (best > 0.0) & (excess[:, i] < best * (1 - TIE_MARGIN))
            chosen = torch.where(better.unsqueeze(1), tried[:, i], chosen)
            best = torch.where(better, excess[:, i], best)
        return chosen

    def _error_bounds(self, t: int) -> Tensor:
        """Return the largest errors that are reckoned with, (n, r).

        Where states are estimated, those of the states are behind them, (n, r + d).
        """
        if self._filter is not None:
            return self._limits.margin * self._filtered_variances(self._filter, t).sqrt()
        ahead = torch.zeros_like(self._scale)
        if self._has_information:
            ahead = self._uncertainty(t).clamp(min=0.0).nan_to_num(nan=0.0)
        self._variances = self._variances[1], ahead
        return self._limits.margin * (self._scale * (1 + ahead)).sqrt()

    def _filtered_variances(self, learner: JointKalmanLearner, t: int) -> Tensor:
        """Return the variances of the accelerations ahead and of the estimates, (n, r + d)."""
        batch = self._batch
        bar = predicted_states(batch.learned, batch.theta, batch.states[:, t])
        both = learner.acceleration_variances(bar), learner.state_variances(t)
        return torch.cat(both, dim=1).clamp(min=0.0).nan_to_num(nan=0.0)

    def _uncertainty(self, t: int) -> Tensor:
        """Return h = g M⁻¹ gᵀ of every acceleration at the predicted state, (n, r)."""
        batch = self._batch
        assert batch.information is not None
        bar = predicted_states(batch.learned, batch.theta, batch.states[:, t])
        zero = torch.zeros_like(batch.inputs[:, t])
        points = batch.points(bar, zero).unsqueeze(1)
        rows = batch.project(batch.learned.jacobian(batch.theta, points).squeeze(1))
        return (rows * batch.information.solve(rows.mT).mT).sum(dim=-1)

    def _excess(self, x: Tensor, tried: Tensor, errors: Tensor) -> Tensor:
        """Return how far beyond the bounds each input leads, (n, C), for inputs (n, C, m)."""
        n, count, m = tried.shape
        k, r, backups = errors.shape[1], self._scale.shape[1], len(self._backups)
        signs = torch.stack([torch.eye(k), -torch.eye(k)], dim=1).flatten(0, 1).to(errors)
        signs = torch.cat([torch.zeros_like(signs[:1]), signs])
        shape = (n, count, len(signs), backups)
        off = (signs * errors.unsqueeze(1))[:, None, :, None].expand(*shape, k)
        state = x[:, None, None, None].expand(*shape, -1)
        off, of_states = off[..., :r], off[..., r:]
        state = state + of_states if k > r else state
        u = tried[:, :, None, None].expand(*shape, m)
        target = self._backups.expand(*shape, m)
        largest = torch.full(shape, -torch.inf).to(x)
        for step in range(self._limits.steps):
            u = self._within(u, target) if step else u
            state = self._next_states(state, u, off)
            beyond = torch.maximum(self._lower - state, state - self._upper).amax(dim=-1)
            lost = ~state.isfinite().all(dim=-1)
            largest = torch.maximum(largest, beyond.masked_fill(lost, torch.inf))
        return largest.amin(dim=3).amax(dim=2)

    def _next_states(self, x: Tensor, u: Tensor, off: Tensor) -> Tensor:
        """Return the states after (n, ..., d) under the model, with errors of accelerations."""
        batch = self._batch

        def accelerations(z: Tensor) -> Tensor:
            values = batch.model(batch.theta, batch.points(z, u).flatten(1, -2))
            return values.view(off.shape) + off

        return next_states(batch.system, x, u, accelerations, batch.system.dt)
