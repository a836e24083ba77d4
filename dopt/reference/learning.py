"""Learning steps over a batch of trials."""

from __future__ import annotations

import functools
from typing import Protocol

import torch
from torch import Tensor

from dopt.algorithm import NO_GROWTH, SMALLEST_SHARE
from dopt.errors import SpecificationError
from dopt.learning import Adam, AdamReplay, AdamRule, ExtendedKalman, GaussNewton, Learner
from dopt.reference.dynamics import LearnedDynamics
from dopt.reference.information import BatchInformation
from dopt.reference.models import BatchModel
from dopt.reference.recorded import Recorded


class BatchLearner(Protocol):
    """Learning in a batch of n trials."""

    def learn(self, states: Tensor, targets: Tensor) -> None:
        """Take one step on states (n, t + 1, d) and observed accelerations (n, t + 1, r)."""


class AdamLearner:
    """Adam on the newest samples, for the whole batch at once, as Adam is elementwise.

    Attributes
    ----------
    moments : pair of (n, q) tensors
        Running means of the gradient and of its square.
    n_steps : int
        Steps that were taken.
    """

    def __init__(
        self, learner: AdamRule, model: BatchModel, theta: Tensor, window: int = 1
    ) -> None:
        self.window = window
        self.moments = torch.zeros_like(theta), torch.zeros_like(theta)
        self.n_steps = 0
        self._rule, self._theta = learner, theta
        self._gradient = Recorded(functools.partial(loss_gradient, model))

    def learn(self, states: Tensor, targets: Tensor) -> None:
        """Take one step on states (n, t + 1, d) and observed accelerations (n, t + 1, r)."""
        newest = slice(-self.window, None)
        self._step(states[:, newest], targets[:, newest])

    def _step(self, states: Tensor, targets: Tensor) -> None:
        """Take one step: what torch.optim.Adam computes, whose own calls take longer than that."""
        gradient, rule = self._gradient(self._theta, states, targets), self._rule
        first, second = self.moments
        self.n_steps += 1
        first.lerp_(gradient, 1.0 - rule.beta_1)
        second.mul_(rule.beta_2).addcmul_(gradient, gradient, value=1.0 - rule.beta_2)
        unbiased = second.sqrt() / (1.0 - rule.beta_2**self.n_steps) ** 0.5
        rate = rule.learning_rate / (1.0 - rule.beta_1**self.n_steps)
        self._theta.addcdiv_(first, unbiased.add_(rule.epsilon), value=-rate)


def loss_gradient(model: BatchModel, theta: Tensor, states: Tensor, targets: Tensor) -> Tensor:
    """Return the gradient of mean_N ‖a_θ(x) - y‖² by θ, (n, q), at (n, N, ·) and (n, N, r)."""
    with torch.enable_grad():
        at = theta.detach().requires_grad_()
        squares = (model(at, states) - targets).square().sum(dim=-1)
        # The gradient of a sum over trials holds that of each.
        (gradient,) = torch.autograd.grad(squares.mean(dim=1).sum(), at)
    return gradient


class ReplayLearner(AdamLearner):
    """Adam on the samples that were last put into the drawn places of a buffer, (n, T, S, B)."""

    def __init__(
        self, learner: AdamReplay, model: BatchModel, theta: Tensor, places: Tensor
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
        self, learned: LearnedDynamics, theta: Tensor, regularization: float, n_learned: int
    ) -> None:
        self._learned, self._whole, self._theta = learned, theta, theta[:, :n_learned]
        prior = regularization * torch.eye(n_learned).to(theta)
        self._normal = prior.repeat(len(theta), 1, 1)
        self._moment = torch.zeros_like(self._theta)

    def learn(self, states: Tensor, targets: Tensor) -> None:
        """Absorb the newest of the states (n, t + 1, d) and targets (n, t + 1, r)."""
        x, y = states[:, -1:], targets[:, -1]
        n_learned = self._theta.shape[1]
        J = self._learned.jacobian(self._whole, x)[:, 0, :, :n_learned]
        nothing = torch.cat([torch.zeros_like(self._theta), self._whole[:, n_learned:]], dim=1)
        offset = self._learned.model(nothing, x).squeeze(1)
        self._normal = self._normal + J.mT @ J
        self._moment = self._moment + (J.mT @ (y - offset).unsqueeze(-1)).squeeze(-1)
        self._theta.copy_(torch.linalg.solve(self._normal, self._moment))


def linearized(learned: LearnedDynamics, theta: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Return J, (n, r, q), and the values of the model, (n, r), for (n, q) at points (n, 1, ·)."""
    return learned.jacobian(theta, x).squeeze(1), learned.model(theta, x).squeeze(1)


class KalmanLearner:
    """The extended Kalman filter in information form.

    M_{t+1} = f M_t + D_t + JᵀJ/ρ and θ += M_{t+1}⁻¹ Jᵀ e/ρ. Underweighted, R takes the place of ρ.
    """

    def __init__(
        self,
        learner: ExtendedKalman,
        learned: LearnedDynamics,
        theta: Tensor,
        information: BatchInformation,
        regularization: float,
    ) -> None:
        self._learner, self._learned, self._theta = learner, learned, theta
        self._information = information
        self._linearized = Recorded(functools.partial(linearized, learned))
        self._renewal = learner.renewal(theta.shape[1], regularization)

    def learn(self, states: Tensor, targets: Tensor) -> None:
        """Absorb the newest of the states (n, t + 1, d) and targets (n, t + 1, r)."""
        x, y = states[:, -1:], targets[:, -1]
        J, values = self._linearized(self._theta, x)
        e = (y - values).unsqueeze(-1)
        self._information.scale(self._learner.forgetting)
        self._information.add(self._given_back(states.shape[1] - 1))
        noise = self._learner.noise_variance
        if self._learner.underweighting > 0.0:
            L, noise = self._noise_factor(J), 1.0
            J, e = (torch.linalg.solve_triangular(L, part, upper=False) for part in (J, e))
        self._information.add(J * noise**-0.5)
        self._theta.add_(self._information.solve(J.mT @ e / noise).squeeze(-1))

    def _noise_factor(self, J: Tensor) -> Tensor:
        """Return the Cholesky factor of R = ρI + ζ J M⁻¹ Jᵀ, (n, r, r); NaN where there is none."""
        predicted = J @ self._information.solve(J.mT)
        noise = self._learner.noise_variance * torch.eye(J.shape[1]).to(J)
        factor, failed = torch.linalg.cholesky_ex(noise + self._learner.underweighting * predicted)
        return torch.where(failed[:, None, None] > 0, torch.nan, factor)

    def _given_back(self, t: int) -> Tensor:
        """Return rows, (n, k, q), the sum of whose squares is the diagonal D_t."""
        n, q = self._theta.shape
        k, weight = self._renewal
        turn = torch.arange(t * k, (t + 1) * k, device=self._theta.device) % q
        rows = self._theta.new_zeros(k, q)
        rows[torch.arange(k), turn] = weight**0.5
        return rows.expand(n, k, q)


class GaussNewtonLearner(KalmanLearner):
    """Gauss-Newton on the samples of the buffer, and the Kalman filter between two fits."""

    def __init__(
        self,
        learner: GaussNewton,
        learned: LearnedDynamics,
        theta: Tensor,
        information: BatchInformation,
        regularization: float,
    ) -> None:
        between = ExtendedKalman(noise_variance=learner.noise_variance)
        super().__init__(between, learned, theta, information, regularization)
        self._fit, self.prior = learner, theta.clone()
        self._regularization = regularization
        self._ridge = regularization * learner.noise_variance

    def learn(self, states: Tensor, targets: Tensor) -> None:
        """Learn from the states (n, t + 1, d) and targets (n, t + 1, r)."""
        if (states.shape[1] - 1) % self._fit.refit_every:
            super().learn(states, targets)
            return
        newest = slice(-self._fit.capacity, None)
        for _ in range(self._fit.steps):
            self._step(states[:, newest], targets[:, newest])

    def _step(self, x: Tensor, y: Tensor) -> None:
        """Take one damped step on (n, N, d) and (n, N, r); M is that before it."""
        J = self._learned.jacobian(self._theta, x).flatten(1, 2)
        e = (y - self._learned.model(self._theta, x)).flatten(1).unsqueeze(-1)
        distance = (self.prior - self._theta).unsqueeze(-1)
        noise = self._fit.noise_variance
        prior = self._regularization * torch.eye(J.shape[-1]).to(J)
        self._information.replace(J.mT @ J / noise + prior)
        step = self._information.solve(J.mT @ e / noise + self._regularization * distance)
        step = step.squeeze(-1)
        before, share = self._theta.clone(), torch.ones_like(self._theta[:, :1])
        bound = self._objective(before, x, y) * NO_GROWTH
        while True:
            self._theta.copy_(before + share * step)
            worse = ~(self._objective(self._theta, x, y) <= bound) & (share > 0)
            if not worse.any():
                return
            smaller = torch.where(share > SMALLEST_SHARE, share / 2, 0.0)
            share = torch.where(worse, smaller, share)

    def _objective(self, theta: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Return ‖e‖² + λρ ‖θ - θ₀‖², (n, 1)."""
        squares = (y - self._learned.model(theta, x)).square().sum(dim=(1, 2))
        whole = squares + self._ridge * (theta - self.prior).square().sum(dim=1)
        return whole.unsqueeze(1)


def learner_for(
    learner: Learner,
    model: BatchModel,
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
