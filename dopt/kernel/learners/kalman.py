"""Recursive learners in compiled code (:mod:`dopt.learning.least_squares`).

Recursive least squares; the extended Kalman filter, whose numbers are ρ, the forgetting factor f,
the count of diagonal entries of M renewed at a step, what each gets back, and ζ; and conditioning
of a Gaussian process.
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import ModelKind
from dopt.kernel.compiler import compiled
from dopt.kernel.gaussian_process import add_sample
from dopt.kernel.learners.adam import sampled_point
from dopt.kernel.linear_algebra import (
    append_row,
    factorize,
    quadratic_forms,
    rank_update,
    settle,
    solve_columns,
)
from dopt.kernel.model import parameter_rows, sampled_state, write_jacobian
from dopt.kernel.structs import Covariance, Network, Plant, Trial
from dopt.kernel.vectors import LANES, add_multiple
from dopt.types import Matrix, Vector


@compiled
def model_rows(plant: Plant, network: Network, theta: Vector, x: Vector, value: Vector) -> Matrix:
    """Return J, (r, q), at a point, and write a_θ, (r,), there."""
    rows = np.empty((value.shape[0], theta.shape[0]))
    if network.kind == ModelKind.MLP:
        write_jacobian(network, theta, x, rows, value)
    else:
        parameter_rows(plant, network, theta, x, rows, value)
    return rows


@compiled
def filter_step(covariance: Covariance, theta: Vector, rows: Matrix, residuals: Vector) -> None:
    """Add JᵀJ to M for J, (r, q), and correct θ by the residuals, (r,), which are overwritten."""
    correction = rank_update(covariance, rows, residuals)
    for i in range(theta.shape[0]):
        theta[i] += correction[i]


@compiled
def forget(covariance: Covariance, forgetting: float, t: int, renewed: int, renewal: float) -> None:
    """Turn M⁻¹ into (f M + D)⁻¹ at step t (:class:`dopt.learning.ExtendedKalman`).

    D has the entry ``renewal`` at the ``renewed`` diagonal places whose turn it is.
    """
    settle(covariance)
    upper, pending, q = covariance.upper, covariance.pending, covariance.size
    for i in range(q):
        row = upper[i, i - i % LANES :]
        for j in range(row.shape[0]):
            row[j] /= forgetting
    for k in range(covariance.n_pending[0]):
        for j in range(q):
            pending[k, j] /= np.sqrt(forgetting)
    column = np.empty(q)
    for n in range(renewed):
        i = (t * renewed + n) % q
        _read_column(covariance, i, column)
        factor = np.sqrt(renewal / (1.0 + renewal * column[i]))
        for j in range(q):
            column[j] *= factor
        append_row(covariance, column)


@compiled
def _read_column(covariance: Covariance, i: int, out: Vector) -> None:
    """Write column i of M⁻¹, (q,)."""
    upper, pending, q = covariance.upper, covariance.pending, covariance.size
    for j in range(out.shape[0]):
        out[j] = upper[min(i, j), max(i, j)]
    for k in range(covariance.n_pending[0]):
        add_multiple(out, -pending[k, i], pending[k, :q])


@compiled
def learn_recursively(trial: Trial, t: int, target: Vector) -> None:
    """Take the least-squares step on the observed accelerations, (r,), and update M."""
    theta, covariance = trial.state.theta, trial.state.covariance
    residuals = np.empty(target.shape[0])
    rows = model_rows(trial.plant, trial.network, theta, sampled_point(trial, t), residuals)
    for k in range(target.shape[0]):
        residuals[k] = target[k] - residuals[k]
    filter_step(covariance, theta, rows, residuals)


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


@compiled
def condition(trial: Trial, t: int, target: Vector) -> None:
    """Add the sample of step t, whose accelerations are (r,), to a Gaussian process."""
    x = sampled_state(trial.plant, trial.record.states, t)
    add_sample(trial.network, trial.state.theta, trial.state.posterior, x, target)
