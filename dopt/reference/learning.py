"""Learning steps over a batch of trials."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor
from torch.func import grad, jacrev, vmap

from dopt.algorithm import NO_GROWTH, SMALLEST_SHARE
from dopt.errors import SpecificationError
from dopt.learning import Adam, AdamReplay, AdamRule, ExtendedKalman, GaussNewton, Learner
from dopt.reference.models import Accelerations


class BatchLearner(Protocol):
    """Learning in a batch of n trials."""

    def learn(self, states: Tensor, targets: Tensor) -> None:
        """Take one step on states (n, t + 1, d) and observed accelerations (n, t + 1, r)."""


class AdamLearner:
    """Adam on the newest samples; one optimiser for the whole batch, as Adam is elementwise."""

    def __init__(
        self, learner: AdamRule, model: Accelerations, theta: Tensor, window: int = 1
    ) -> None:
        self.window = window
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
        self._step(states[:, newest], targets[:, newest])

    def _step(self, states: Tensor, targets: Tensor) -> None:
        self._theta.grad = self._gradient(self._theta, states, targets)
        self.optimizer.step()


class ReplayLearner(AdamLearner):
    """Adam on the samples that were last put into the drawn places of a buffer, (n, T, S, B)."""

    def __init__(
        self, learner: AdamReplay, model: Accelerations, theta: Tensor, places: Tensor
    ) -> None:
        super().__init__(learner, model, theta)
        self._capacity, self._places = learner.capacity, places

    def learn(self, states: Tensor, targets: Tensor) -> None:
        """Take the steps of time t on states (n, t + 1, d) and accelerations (n, t + 1, r)."""
        t = states.shape[1] - 1
        for place in self._places[:, t].unbind(1):
            times = (t - (t - place) % self._capacity).unsqueeze(-1)
            self._step(
                torch.take_along_dim(states, times, 1), torch.take_along_dim(targets, times, 1)
            )


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


class KalmanLearner:
    """The extended Kalman filter in information form: M is summed, and solved afresh.

    M_{t+1} = f M_t + D_t + JᵀJ/ρ and θ += M_{t+1}⁻¹ Jᵀ e/ρ. Underweighted, R takes the place of ρ.
    """

    def __init__(
        self, learner: ExtendedKalman, model: Accelerations, theta: Tensor, regularization: float
    ) -> None:
        self._learner, self._theta = learner, theta
        self._model, self._rows = vmap(model), vmap(jacrev(model))
        self._renewal = learner.renewal(theta.shape[1], regularization)

    def filtered(self, states: Tensor, targets: Tensor, information: Tensor) -> Tensor:
        """Absorb the newest of the states (n, t + 1, d) and targets (n, t + 1, r); return M."""
        x, y = states[:, -1], targets[:, -1]
        J, e = self._rows(self._theta, x), (y - self._model(self._theta, x)).unsqueeze(-1)
        given_back = torch.diag(self._given_back(states.shape[1] - 1))
        faded = self._learner.forgetting * information + given_back
        noise = self._learner.noise_variance
        if self._learner.underweighting > 0.0:
            L, noise = self._noise_factor(faded, J), 1.0
            J, e = (torch.linalg.solve_triangular(L, part, upper=False) for part in (J, e))
        information = faded + J.mT @ J / noise
        self._theta.add_(solved(information, J.mT @ e / noise))
        return information

    def _noise_factor(self, information: Tensor, J: Tensor) -> Tensor:
        """Return the Cholesky factor of R = ρI + ζ J M⁻¹ Jᵀ, (n, r, r); NaN where there is none."""
        predicted = J @ torch.cholesky_solve(J.mT, torch.linalg.cholesky_ex(information)[0])
        noise = self._learner.noise_variance * torch.eye(J.shape[1]).to(J)
        factor, failed = torch.linalg.cholesky_ex(noise + self._learner.underweighting * predicted)
        return torch.where(failed[:, None, None] > 0, torch.nan, factor)

    def _given_back(self, t: int) -> Tensor:
        """Return the diagonal of D_t, (q,)."""
        diagonal = torch.zeros_like(self._theta[0])
        k, weight = self._renewal
        turn = torch.arange(t * k, (t + 1) * k, device=diagonal.device)
        diagonal[turn % len(diagonal)] = weight
        return diagonal


class GaussNewtonLearner(KalmanLearner):
    """Gauss-Newton on the samples of the buffer, and the Kalman filter between two fits."""

    def __init__(
        self, learner: GaussNewton, model: Accelerations, theta: Tensor, regularization: float
    ) -> None:
        between = ExtendedKalman(noise_variance=learner.noise_variance)
        super().__init__(between, model, theta, regularization)
        self._fit, self.prior = learner, theta.clone()
        self._ridge = regularization * learner.noise_variance
        self._models = vmap(vmap(model, in_dims=(None, 0)))
        self._all_rows = vmap(vmap(jacrev(model), in_dims=(None, 0)))

    def filtered(self, states: Tensor, targets: Tensor, information: Tensor) -> Tensor:
        """Learn from the states (n, t + 1, d) and targets (n, t + 1, r); return M."""
        if (states.shape[1] - 1) % self._fit.refit_every:
            return super().filtered(states, targets, information)
        newest = slice(-self._fit.capacity, None)
        for _ in range(self._fit.steps):
            information = self._stepped(states[:, newest], targets[:, newest])
        scaled: Tensor = information / self._fit.noise_variance
        return scaled

    def _stepped(self, x: Tensor, y: Tensor) -> Tensor:
        """Take one damped step on (n, N, d) and (n, N, r); return ρM before it."""
        J = self._all_rows(self._theta, x).flatten(1, 2)
        e = (y - self._models(self._theta, x)).flatten(1).unsqueeze(-1)
        distance = (self.prior - self._theta).unsqueeze(-1)
        matrix: Tensor = J.mT @ J + self._ridge * torch.eye(J.shape[-1]).to(J)
        step = solved(matrix, J.mT @ e + self._ridge * distance)
        before, share = self._theta.clone(), torch.ones_like(self._theta[:, :1])
        bound = self._objective(before, x, y) * NO_GROWTH
        while True:
            self._theta.copy_(before + share * step)
            worse = ~(self._objective(self._theta, x, y) <= bound) & (share > 0)
            if not worse.any():
                return matrix
            smaller = torch.where(share > SMALLEST_SHARE, share / 2, 0.0)
            share = torch.where(worse, smaller, share)

    def _objective(self, theta: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Return ‖e‖² + λρ ‖θ - θ₀‖², (n, 1)."""
        squares = (y - self._models(theta, x)).square().sum(dim=(1, 2))
        whole = squares + self._ridge * (theta - self.prior).square().sum(dim=1)
        return whole.unsqueeze(1)


def solved(matrix: Tensor, right: Tensor) -> Tensor:
    """Return the solutions, (n, q), for matrices and columns, (n, q, 1).

    NaN where rounding has left a matrix indefinite.
    """
    factor, failed = torch.linalg.cholesky_ex(matrix)
    solution = torch.cholesky_solve(right, factor).squeeze(-1)
    return torch.where(failed.unsqueeze(-1) > 0, torch.nan, solution)


def learner_for(
    learner: Learner,
    model: Accelerations,
    theta: Tensor,
    replay: Tensor | None = None,
) -> BatchLearner:
    """Return the batch learner by gradients of a specification; it writes into ``theta`` (n, q)."""
    if isinstance(learner, Adam):
        return AdamLearner(learner, model, theta, learner.window)
    if isinstance(learner, AdamReplay) and replay is not None:
        return ReplayLearner(learner, model, theta, replay)
    raise SpecificationError(
        f"the reference has no update for learner '{learner.name}': derive its class from "
        f"CustomLearner, or enter an update in dopt.reference.learner_registry."
    )
