"""Filter over state and parameters, and fits of all that was measured, for a batch of trials.

Twin of :mod:`dopt.kernel.learners.joint_kalman`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dopt.algorithm import MOST_NOISE_FACTORS, NO_GROWTH, NOISE_FACTORS, SMALLEST_SHARE
from dopt.learning import JointKalman
from dopt.reference.derivatives import jacobian
from dopt.reference.information import BatchInformation
from dopt.reference.sensors import BatchSensors
from dopt.reference.state import BatchState


class JointKalmanLearner:
    """The filter of n trials: P, (n, d, d), and Ψ, (n, d, q)."""

    def __init__(
        self, learner: JointKalman, batch: BatchState, sensors: BatchSensors, regularization: float
    ) -> None:
        self._learner, self._batch, self._sensors = learner, batch, sensors
        self._ridge, self._prior = regularization, batch.theta.clone()
        self._noise = torch.full_like(batch.theta[:, 0], learner.noise_variance)  # ρ, (n,)
        n, d, q = len(batch.specs), batch.system.n_states, batch.n_learned
        self._P, self._psi = batch.theta.new_zeros(n, d, d), batch.theta.new_zeros(n, d, q)
        self._E = batch.theta.new_zeros(d, batch.system.n_learned)
        for column, row in enumerate(batch.system.learned_rows):
            self._E[row, column] = 1.0

    @property
    def _information(self) -> BatchInformation:
        assert self._batch.information is not None
        return self._batch.information

    def filter(self, t: int) -> None:
        """Take in what was measured of x_{t+1}, of which the prediction stands there."""
        batch, learner, information = self._batch, self._learner, self._information
        x, following, u = batch.states[:, t], batch.states[:, t + 1], batch.inputs[:, t]
        theta, dt = batch.theta, self._sensors.durations[t]
        J = self._rows(theta, batch.points(self._learned_at(x, following), u))
        spread = J @ information.solve(J.mT)
        noise = self._noise[:, None, None] * torch.eye(J.shape[1]).to(J)
        noise = noise + learner.underweighting * spread
        A = self._state_jacobian(theta, x, u, dt)
        self._P, self._psi = self._begun(t, self._P, self._psi)
        P = A @ self._P @ A.mT + dt**2 * self._E @ noise @ self._E.T
        psi = A @ self._psi + dt * self._E @ J
        for i, c in enumerate(self._sensors.C):
            error = self._sensors.outputs[:, t, i] - following @ c
            variance = P @ c @ c + self._sensors.variances[i]
            h, K = c @ psi, P @ c / variance[:, None]
            information.add((h * variance.rsqrt()[:, None]).unsqueeze(1))
            change = information.solve((h * (error / variance)[:, None]).unsqueeze(-1))
            P = P - variance[:, None, None] * K[:, :, None] * K[:, None, :]
            psi = psi - K[:, :, None] * h[:, None, :]
            theta.add_(change.squeeze(-1))
            following.add_(K * error[:, None] + (psi @ change).squeeze(-1))
        self._P, self._psi = P, psi
        if (t + 1) % learner.refit_every == 0:
            self._fit(t + 1)

    def acceleration_variances(self, x: Tensor) -> Tensor:
        """Return the variances ρ + g M⁻¹ gᵀ of accelerations at states without input, (n, r)."""
        zero = torch.zeros_like(self._batch.inputs[:, 0])
        J = self._rows(self._batch.theta, self._batch.points(x, zero))
        return self._spread(J) + self._noise[:, None]

    def state_variances(self, t: int) -> Tensor:
        """Return the diagonals of P + Ψ M⁻¹ Ψᵀ, the variances of the estimates x̂_t, (n, d)."""
        P, psi = self._begun(t, self._P, self._psi)
        return P.diagonal(dim1=1, dim2=2) + self._spread(psi)

    def _spread(self, rows: Tensor) -> Tensor:
        """Return the diagonals of R M⁻¹ Rᵀ, (n, k), of rows R, (n, k, q)."""
        return (rows * self._information.solve(rows.mT).mT).sum(dim=-1)

    def _rows(self, theta: Tensor, points: Tensor) -> Tensor:
        """Return J, (n, r, q), at points (n, ·)."""
        return self._batch.learned.jacobian(theta, points.unsqueeze(1)).squeeze(1)

    def _begun(self, t: int, P: Tensor, psi: Tensor) -> tuple[Tensor, Tensor]:
        """Return P and Ψ before step t, those of a state of its own where it begins anew."""
        anew = self._sensors.starts[:, t, :1].isfinite().unsqueeze(-1)
        start = torch.diag(self._sensors.start_variances)
        return torch.where(anew, start, P), torch.where(anew, 0.0, psi)

    def _learned_at(self, x: Tensor, following: Tensor) -> Tensor:
        euler = self._batch.system.integrator == "euler"
        return x if euler else 0.5 * (x + following)

    def _state_jacobian(self, theta: Tensor, x: Tensor, u: Tensor, dt: float) -> Tensor:
        """Return ∂x_{t+1}/∂x_t of the model's step, (n, d, d)."""
        return jacobian(lambda at: self._batch.learned.next_states(theta, at, u, dt), x)

    def _fit(self, n: int) -> None:
        """Fit θ, and ρ if asked to, to what was measured in n steps; M is that of the fit."""
        theta = self._batch.theta
        for _ in range(self._learner.steps):
            before, J, e = self._run(n)
            right = J.mT @ e.unsqueeze(-1) + self._ridge * (self._prior - theta).unsqueeze(-1)
            self._information.replace(self._normal(J))
            step, start = self._information.solve(right).squeeze(-1), theta.clone()
            share = torch.ones_like(theta[:, :1])
            bound = before + (NO_GROWTH - 1.0) * before.abs()
            while True:
                theta.copy_(start + share * step)
                worse = ~(self._run(n)[0] <= bound).unsqueeze(1) & (share > 0)
                if not worse.any():
                    break
                smaller = torch.where(share > SMALLEST_SHARE, share / 2, 0.0)
                share = torch.where(worse, smaller, share)
        if self._learner.fits_noise:
            self._fit_noise(n)
        _, J, _ = self._run(n, keep=True)
        self._information.replace(self._normal(J))

    def _fit_noise(self, n: int) -> None:
        """Move ρ by factors as long as the errors of n steps become likelier, at the present θ."""
        lowest = self._run(n)[0]
        for factor in NOISE_FACTORS:
            moving = torch.ones_like(lowest, dtype=torch.bool)
            for _ in range(MOST_NOISE_FACTORS):
                held, self._noise = self._noise, torch.where(moving, factor, 1.0) * self._noise
                found = self._run(n)[0]
                moving = moving & (found < lowest)
                self._noise = torch.where(moving, self._noise, held)
                lowest = torch.where(moving, found, lowest)
                if not moving.any():
                    break

    def _normal(self, J: Tensor) -> Tensor:
        total: Tensor = J.mT @ J + self._ridge * torch.eye(J.shape[-1]).to(J)
        return total

    def _run(self, n: int, *, keep: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Filter n steps at the present θ.

        Returns the objective, (n,), the whitened rows C Ψ/√s, (n, N, q), and errors, (n, N);
        ``keep`` writes x̂_n, P and Ψ.
        """
        batch, sensors, theta = self._batch, self._sensors, self._batch.theta
        x, P, psi = batch.states[:, 0], torch.zeros_like(self._P), torch.zeros_like(self._psi)
        noise = self._noise[:, None, None] * (self._E @ self._E.T)
        total = self._ridge * (theta - self._prior).square().sum(dim=1)
        rows, errors = [], []
        for t in range(n):
            u, dt = batch.inputs[:, t], sensors.durations[t]
            P, psi = self._begun(t, P, psi)
            x = torch.where(sensors.starts[:, t].isfinite(), sensors.starts[:, t], x)
            following = batch.learned.next_states(theta, x, u, dt)
            A = self._state_jacobian(theta, x, u, dt)
            J = self._rows(theta, batch.points(self._learned_at(x, following), u))
            P, psi, x = A @ P @ A.mT + dt**2 * noise, A @ psi + dt * self._E @ J, following
            for i, c in enumerate(sensors.C):
                error = sensors.outputs[:, t, i] - x @ c
                variance = P @ c @ c + sensors.variances[i]
                total = total + error**2 / variance + variance.log()
                K, scale, h = P @ c / variance[:, None], variance.rsqrt(), c @ psi
                rows.append(h * scale[:, None])
                errors.append(error * scale)
                P = P - variance[:, None, None] * K[:, :, None] * K[:, None, :]
                psi = psi - K[:, :, None] * h[:, None, :]
                x = x + K * error[:, None]
        if keep:
            batch.states[:, n], self._P, self._psi = x, P, psi
        return total, torch.stack(rows, dim=1), torch.stack(errors, dim=1)
