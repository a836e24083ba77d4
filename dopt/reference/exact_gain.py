"""Exact one-step information gain (Definition 1 of the paper) and its maximum over inputs.

By the determinant lemma log det(M + JᵀJ) = log det M + log det(I + J M⁻¹ Jᵀ), with r × r matrices.

======  =======================================================  =========
symbol  meaning                                                  shape
======  =======================================================  =========
M       information matrix, of the s dimensions that J has       s × s
J       Jacobian of the learned accelerations at x(u), over √ρ   r × s
u       input, here on the sphere ‖u‖ = γ                        m
======  =======================================================  =========
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from dopt.policies.gradient import GradientDOptimal
from dopt.reference.state import BatchState

WIDENING = 4.0
"""Largest factor from the angle of one ascent step to where the next one aims."""

LEAST_ANGLE = 1e-9
"""Smallest angle of an ascent step [rad]."""


class Situation(NamedTuple):
    """Arguments of a gain beside the input, for n trials."""

    theta: Tensor  # (n, q)
    covariance: Tensor  # (n, s, s), M⁻¹
    x: Tensor  # (n, d)
    component: Tensor  # (n,), which one counts where a single one does


def log_det_gain(rows: Tensor, covariance: Tensor) -> Tensor:
    """Return log det(I + J M⁻¹ Jᵀ), (...), for J (..., r, s) and M⁻¹ (..., s, s)."""
    S = rows @ covariance @ rows.mT
    if S.shape[-1] == 1:
        return S[..., 0, 0].log1p()
    factor, _ = torch.linalg.cholesky_ex(S + torch.eye(S.shape[-1]).to(S))
    return torch.diagonal(factor, dim1=-2, dim2=-1).square().log().sum(dim=-1)


class ExactGain:
    """G_D(u) - log det M of Definition 1 for a batch: of all learned components, or of one."""

    def __init__(self, batch: BatchState, *, single: bool = False) -> None:
        self._learned, self._project, self._single = batch.learned, batch.project, single
        self._scale = batch.held.noise_variance**-0.5 if batch.held else 1.0

    def values(self, u: Tensor, now: Situation) -> Tensor:
        """Return the gains, (n, C), of inputs (n, C, m)."""
        theta, covariance, x, component = now
        x = x.unsqueeze(1).expand(-1, u.shape[1], -1)
        following = self._learned.following(theta, x, u)
        J = self._learned.jacobian(theta, following, differentiable=u.requires_grad)
        rows = self._scale * self._project(J)
        if self._single:
            rows = rows[torch.arange(len(rows)), :, component].unsqueeze(2)
        return log_det_gain(rows, covariance.unsqueeze(1))

    def slopes(self, u: Tensor, now: Situation) -> tuple[Tensor, Tensor]:
        """Return the slopes, (n, C, m), and the gains, (n, C), of inputs (n, C, m)."""
        with torch.enable_grad():
            u = u.detach().requires_grad_()
            gains = self.values(u, now)
            (slopes,) = torch.autograd.grad(gains.sum(), u)
        return slopes, gains.detach()

    def optimum(self, starts: Tensor, now: Situation, search: GradientDOptimal) -> Tensor:
        """Return the best inputs, (n, m), found from inputs (n, C, m) on the sphere."""
        values = self.values(starts, now)
        count = min(search.starts, starts.shape[1])
        chosen = values.topk(count, dim=1).indices
        u = starts.gather(1, chosen.unsqueeze(-1).expand(-1, -1, starts.shape[2]))
        values = values.gather(1, chosen)
        if starts.shape[2] > 1:
            angle = math.pi / starts.shape[1]
            u, values = ascend(lambda v: self.slopes(v, now), u, angle, search.iterations)
        return u[torch.arange(len(u)), values.argmax(dim=1)]


def ascend(
    gain: Callable[[Tensor], tuple[Tensor, Tensor]],
    starts: Tensor,
    angle: float,
    iterations: int,
) -> tuple[Tensor, Tensor]:
    """Ascend on the sphere from starts (..., m); return where it ends, and the values there.

    Each step goes along the great circle of the projected gradient. Its angle is where the secant
    of the slopes along the last circle is zero, and at most half of one that gained nothing.

    Parameters
    ----------
    gain : callable
        From inputs (..., m) to slopes (..., m) and values (...).
    angle : float
        First step [rad].
    """
    u, (slope, value) = starts, gain(starts)
    radius = torch.linalg.vector_norm(starts, dim=-1, keepdim=True)
    angles = torch.full_like(radius, angle)
    for _ in range(iterations):
        tangent = slope - (slope * u).sum(dim=-1, keepdim=True) / radius.square() * u
        length = torch.linalg.vector_norm(tangent, dim=-1, keepdim=True)
        along = radius * tangent / length.clamp_min(1e-300)
        tried = angles.cos() * u + angles.sin() * along
        # At an optimum the tangent is rounding, which may point off the sphere.
        tried = tried * (radius / torch.linalg.vector_norm(tried, dim=-1, keepdim=True))
        new_slope, new_value = gain(tried)
        onwards = angles.cos() * along - angles.sin() * u
        fall = (radius * length - (new_slope * onwards).sum(dim=-1, keepdim=True)) / angles
        flat = torch.where(fall > 0.0, radius * length / fall, WIDENING * angles)
        root = torch.minimum(flat, WIDENING * angles)
        better = (new_value > value).unsqueeze(-1)
        u, slope = torch.where(better, tried, u), torch.where(better, new_slope, slope)
        value = torch.where(better.squeeze(-1), new_value, value)
        angles = torch.where(better, (root - angles).abs(), torch.minimum(root, angles / 2))
        angles = angles.clamp_min(LEAST_ANGLE)
    return u, value


class GradientPlan:
    """The exact optimum of each trial: candidates first, then ascent from the best."""

    def __init__(self, batch: BatchState, policy: GradientDOptimal) -> None:
        self._batch, self._policy = batch, policy
        self._gain = ExactGain(batch)
        self._candidates = candidates(batch, policy)

    def plan(self, t: int) -> Tensor:
        """Return the inputs u_t, (n, m)."""
        batch = self._batch
        assert batch.information is not None
        covariance = batch.information.covariance()
        now = Situation(batch.theta, covariance, batch.states[:, t], batch.components[:, t])
        return self._gain.optimum(self._candidates, now, self._policy)

    def inform(self, t: int) -> None:
        """Do nothing: the batch holds M."""


def candidates(batch: BatchState, policy: GradientDOptimal) -> Tensor:
    """Return the candidates of a policy for every trial of a batch, (n, C, m)."""
    inputs = policy.compared_inputs(batch.system)
    return torch.tensor(inputs).to(batch.theta).expand(len(batch.theta), -1, -1)
