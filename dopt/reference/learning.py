"""Learning steps over a batch of trials."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor
from torch.func import grad, jacrev, vmap

from dopt.learning import Adam, Learner
from dopt.reference.models import Accelerations


class BatchLearner(Protocol):
    """Learning in a batch of n trials."""

    def learn(self, states: Tensor, targets: Tensor) -> None:
        """Take one step on states (n, t + 1, d) and observed accelerations (n, t + 1, r)."""


class AdamLearner:
    """Adam on the newest samples; one optimiser for the whole batch, as Adam is elementwise."""

    def __init__(self, learner: Adam, model: Accelerations, theta: Tensor) -> None:
        self.window = learner.window
        self.optimizer = torch.optim.Adam(
            [theta],
            lr=learner.learning_rate,
            betas=(learner.beta_1, learner.beta_2),
            eps=learner.epsilon,
        )
        self._theta = theta

        def loss(parameters: Tensor, x: Tensor, targets: Tensor) -> Tensor:
            errors = vmap(model, in_dims=(None, 0))(parameters, x) - targets
            return errors.square().sum(dim=-1).mean()

        self._gradient = vmap(grad(loss))

    def learn(self, states: Tensor, targets: Tensor) -> None:
        """Take one step on states (n, t + 1, d) and observed accelerations (n, t + 1, r)."""
        newest = slice(-self.window, None)
        self._theta.grad = self._gradient(self._theta, states[:, newest], targets[:, newest])
        self.optimizer.step()


class LeastSquaresLearner:
    """Least squares over all samples with the ridge λ, solved afresh from the normal equations.

    The plain twin of the recursion: θ = (λI + Σ JᵀJ)⁻¹ Σ Jᵀ(y - offset). The first ``n_learned``
    parameters are learned, the others stay.
    """

    def __init__(
        self, model: Accelerations, theta: Tensor, regularization: float, n_learned: int
    ) -> None:
        self._theta = theta[:, :n_learned]
        self._fixed = theta[:, n_learned:]
        self._normal = regularization * torch.eye(n_learned).to(theta).repeat(len(theta), 1, 1)
        self._moment = torch.zeros_like(self._theta)

        def whole(learned: Tensor, fixed: Tensor, x: Tensor) -> Tensor:
            return model(torch.cat([learned, fixed]), x)

        self._model = vmap(whole)
        self._rows = vmap(jacrev(whole))

    def learn(self, states: Tensor, targets: Tensor) -> None:
        """Absorb the newest of the states (n, t + 1, d) and targets (n, t + 1, r)."""
        x, y = states[:, -1], targets[:, -1]
        J = self._rows(self._theta, self._fixed, x)
        offset = self._model(torch.zeros_like(self._theta), self._fixed, x)
        self._normal = self._normal + J.mT @ J
        self._moment = self._moment + (J.mT @ (y - offset).unsqueeze(-1)).squeeze(-1)
        self._theta.copy_(torch.linalg.solve(self._normal, self._moment))


def learner_for(
    learner: Learner,
    model: Accelerations,
    theta: Tensor,
    regularization: float,
    n_learned: int,
) -> BatchLearner:
    """Return the batch learner of a specification; it writes into ``theta`` (n, q).

    Of the parameters the first ``n_learned`` are learned.
    """
    if isinstance(learner, Adam):
        return AdamLearner(learner, model, theta)
    return LeastSquaresLearner(model, theta, regularization, n_learned)
