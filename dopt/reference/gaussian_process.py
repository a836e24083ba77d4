"""Gaussian process regression, one sample at a time, and the plan by its entropy.

======  =====================================================  =========
symbol  meaning                                                shape
======  =====================================================  =========
φ       features of the t states at which samples were taken   t × p
L       Cholesky factor of K + σ²/dt I                         t × t
z       L⁻¹ Y, with Y the observed accelerations               t × r
α       L⁻ᵀ z, weights of the posterior mean                   t × r
======  =====================================================  =========
"""

from __future__ import annotations

import torch
from torch import Tensor

from dopt.models.linear import GaussianProcess
from dopt.policies.gaussian_process import GaussianProcessEntropy
from dopt.reference.dynamics import flow
from dopt.reference.models import features, kernel
from dopt.reference.state import BatchState
from dopt.systems.base import System


class Posterior:
    """The process of each trial given its samples; the learner of :class:`Conditioning`.

    Parameters
    ----------
    theta : (n, q)
        Flat parameters, which are written at each step.
    points : (N, d)
        States at which :meth:`predict_points` is asked again and again.
    """

    def __init__(
        self, system: System, model: GaussianProcess, theta: Tensor, points: Tensor
    ) -> None:
        self._system, self._model = system, model
        n, T, p = len(theta), system.horizon, len(system.features)
        self.noise = model.noise_variance(system)
        self._centers = theta[:, : T * p].view(n, T, p)
        self._alpha = theta[:, T * p :].view(n, T, -1)
        self._factor = torch.zeros(n, T, T).to(theta)
        self._solved = torch.zeros_like(self._alpha)
        self._points = features(system, points)
        self._cross = torch.zeros(n, len(points), T).to(theta)
        self.n_samples = 0

    def learn(self, states: Tensor, targets: Tensor) -> None:
        """Condition on the newest of the states (n, t + 1, d) and targets (n, t + 1, r)."""
        t = self.n_samples
        phi, y = features(self._system, states[:, -1]), targets[:, -1]
        row = self._whitened(phi.unsqueeze(1)).squeeze(-1)
        rest = self._model.amplitude**2 + self.noise - row.square().sum(dim=1)
        # The variance of a new observation is that of its noise at least.
        deviation = rest.clamp_min(self.noise).sqrt()
        known = (row.unsqueeze(1) @ self._solved[:, :t]).squeeze(1)
        self._factor[:, t, :t] = row
        self._factor[:, t, t] = deviation
        self._centers[:, t] = phi
        self._solved[:, t] = (y - known) / deviation.unsqueeze(1)
        self._cross[:, :, t] = kernel(self._model, self._points, phi.unsqueeze(1)).squeeze(-1)
        self.n_samples = t + 1
        factor = self._factor[:, : t + 1, : t + 1]
        self._alpha[:, : t + 1] = torch.linalg.solve_triangular(
            factor.mT, self._solved[:, : t + 1], upper=True
        )

    def predict(self, phi: Tensor) -> Tensor:
        """Return the posterior mean, (n, N, r), at features (n, N, p)."""
        t = self.n_samples
        mean: Tensor = kernel(self._model, phi, self._centers[:, :t]) @ self._alpha[:, :t]
        return mean

    def predict_points(self) -> Tensor:
        """Return the posterior mean at the given points, (n, N, r)."""
        return self._cross[:, :, : self.n_samples] @ self._alpha[:, : self.n_samples]

    def entropies(self, phi: Tensor) -> Tensor:
        """Return log det of the covariance of observations at features (n, C, H, p): (n, C).

        Of each learned acceleration; all have the same.
        """
        n, C, H, p = phi.shape
        whitened = self._whitened(phi.reshape(n, C * H, p)).view(n, -1, C, H).permute(0, 2, 1, 3)
        posterior = kernel(self._model, phi, phi) - whitened.mT @ whitened
        covariance = posterior + self.noise * torch.eye(H).to(phi)
        factor, _ = torch.linalg.cholesky_ex(covariance)
        log_det: Tensor = torch.diagonal(factor, dim1=-2, dim2=-1).square().log().sum(dim=-1)
        return log_det

    def _whitened(self, phi: Tensor) -> Tensor:
        """Return L⁻¹ k, (n, t, N), for features (n, N, p)."""
        t = self.n_samples
        cross = kernel(self._model, self._centers[:, :t], phi)
        factor = self._factor[:, :t, :t]
        whitened: Tensor = torch.linalg.solve_triangular(factor, cross, upper=False)
        return whitened


class EntropyPlan:
    """Choice by the joint predictive entropy at the states that an input leads to."""

    def __init__(
        self, batch: BatchState, policy: GaussianProcessEntropy, posterior: Posterior
    ) -> None:
        self._batch, self._posterior, self._lookahead = batch, posterior, policy.lookahead
        self._inputs = torch.tensor(policy.compared_inputs(batch.system)).to(batch.theta)

    def plan(self, t: int) -> Tensor:
        """Return the inputs u_t, (n, m)."""
        system, posterior = self._batch.system, self._posterior
        z = self._batch.states[:, t].unsqueeze(1).expand(-1, len(self._inputs), -1)
        inputs, visited = self._inputs.expand(*z.shape[:2], -1), []
        for _ in range(self._lookahead):
            predicted = posterior.predict(features(system, z))
            z = z + system.dt * flow(system, z, inputs, predicted)
            visited.append(features(system, z))
        return self._inputs[posterior.entropies(torch.stack(visited, dim=2)).argmax(dim=1)]

    def inform(self, t: int) -> None:
        """Do nothing: the posterior is the trial's own learner."""
