"""The extended Kalman filter in compiled code (:mod:`dopt.learning.extended_kalman`).

Its numbers are ρ, f, the count of diagonal entries of M renewed at a step and what each gets back.
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.information.forgetting import forget
from dopt.kernel.information.update import filter_step, model_rows
from dopt.kernel.structs import Trial
from dopt.types import Matrix, Vector


@compiled
def learn(trial: Trial, t: int, target: Vector) -> None:
    """Filter the observed accelerations, (r,): update θ and M."""
    numbers = trial.algorithm.learner
    filter_sample(trial, t, target, numbers[0], numbers[1], int(numbers[2]), numbers[3])


@compiled
def filter_sample(
    trial: Trial,
    t: int,
    target: Vector,
    noise_variance: float,
    forgetting: float,
    renewed: int,
    renewal: float,
) -> None:
    """Update θ and M by the sample of step t, after M has faded by a factor."""
    theta, covariance = trial.state.theta, trial.state.covariance
    residuals = np.empty(target.shape[0])
    rows = model_rows(trial.plant, trial.network, theta, trial.record.states[t], residuals)
    for k in range(target.shape[0]):
        residuals[k] = target[k] - residuals[k]
    if forgetting < 1.0:
        forget(covariance, forgetting, t, renewed, renewal)
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
