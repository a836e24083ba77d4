"""The extended Kalman filter in compiled code (:mod:`dopt.learning.least_squares`).

Its numbers are ρ, f, the count of diagonal entries of M renewed at a step, what each gets back,
and ζ.
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.information.cholesky import factorize, solve_columns
from dopt.kernel.information.forgetting import forget
from dopt.kernel.information.primal import quadratic_forms
from dopt.kernel.information.update import filter_step, model_rows
from dopt.kernel.learners.samples import sampled_point
from dopt.kernel.state_structs import Covariance
from dopt.kernel.structs import Trial
from dopt.types import Matrix, Vector


@compiled
def learn(trial: Trial, t: int, target: Vector) -> None:
    """Filter the observed accelerations, (r,): update θ and M."""
    numbers = trial.algorithm.learner
    filter_sample(trial, t, target, numbers[0], numbers[1], int(numbers[2]), numbers[3], numbers[4])


@compiled
def filter_sample(
    trial: Trial,
    t: int,
    target: Vector,
    noise_variance: float,
    forgetting: float,
    renewed: int,
    renewal: float,
    underweighting: float,
) -> None:
    """Update θ and M by the sample of step t, after M has faded by a factor."""
    theta, covariance = trial.state.theta, trial.state.covariance
    residuals = np.empty(target.shape[0])
    rows = model_rows(trial.plant, trial.network, theta, sampled_point(trial, t), residuals)
    for k in range(target.shape[0]):
        residuals[k] = target[k] - residuals[k]
    if forgetting < 1.0:
        forget(covariance, forgetting, t, renewed, renewal)
    if underweighting > 0.0:
        whiten(covariance, rows, residuals, noise_variance, underweighting)
    else:
        scale_by_noise(rows, residuals, noise_variance)
    filter_step(covariance, theta, rows, residuals)


@compiled
def scale_by_noise(rows: Matrix, residuals: Vector, noise_variance: float) -> None:
    """Divide J, (r, q), and the residuals, (r,), by √ρ."""
    scale = 1.0 / np.sqrt(noise_variance)
    for k in range(rows.shape[0]):
        residuals[k] *= scale
        for i in range(rows.shape[1]):
            rows[k, i] *= scale


@compiled
def whiten(
    covariance: Covariance,
    rows: Matrix,
    residuals: Vector,
    noise_variance: float,
    underweighting: float,
) -> None:
    """Multiply J, (r, q), and the residuals, (r,), by L⁻¹, where L Lᵀ = ρI + ζ J M⁻¹ Jᵀ.

    The residuals are NaN, which ends the trial as diverged, where rounding has left no L.
    """
    L = quadratic_forms(covariance, rows, rows)
    for k in range(L.shape[0]):
        for i in range(L.shape[1]):
            L[k, i] = underweighting * L[k, i] + (noise_variance if i == k else 0.0)
    if not factorize(L):
        residuals[:] = np.nan
        return
    solve_columns(L, rows)
    solve_columns(L, residuals.reshape(-1, 1))
