"""Gauss-Newton steps on all samples in compiled code (:mod:`dopt.learning.least_squares`).

Its numbers are λ, ρ, the steps from one fit to the next and the Gauss-Newton steps of a fit.
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import NO_GROWTH, SMALLEST_SHARE, ModelKind
from dopt.kernel import grey_box
from dopt.kernel.compiler import compiled, squared
from dopt.kernel.information.cholesky import factorize, solve, write_inverse
from dopt.kernel.information.normal_equations import errors_of, normal_equations
from dopt.kernel.learners.kalman import filter_sample
from dopt.kernel.learners.samples import sampled_point, store_sample
from dopt.kernel.state_structs import State
from dopt.kernel.structs import Network, Plant, Trial
from dopt.types import Matrix, Vector


@compiled
def learn(trial: Trial, t: int, target: Vector) -> None:
    """Fit all samples, or filter the newest one between two fits."""
    numbers, state = trial.algorithm.learner, trial.state
    noise_variance, refit_every, steps = numbers[1], int(numbers[2]), int(numbers[3])
    seen, observed = state.window_features, state.window_targets
    store_sample(trial.network, seen, observed, t, sampled_point(trial, t), target)
    if t % refit_every != 0:
        filter_sample(trial, t, target, noise_variance, 1.0, 0, 0.0, 0.0)
        return
    n, q = min(t + 1, seen.shape[1]), state.theta.shape[0]
    features, targets = seen[:, :n].copy(), observed[:, :n].copy()
    ridge, factor = numbers[0] * noise_variance, np.empty((q, q))
    definite = True
    for _ in range(steps):
        definite = definite and take_step(
            trial.plant, trial.network, state.theta, state.prior, ridge, features, targets, factor
        )
    if not (definite and _write_information(state, factor, noise_variance)):
        state.theta[:] = np.nan  # which ends the trial as diverged


@compiled
def _write_information(state: State, factor: Matrix, noise_variance: float) -> bool:
    """Write M⁻¹ and the factor of M, where they are held; tell whether M⁻¹ is finite.

    Given is the factor of ρ M.
    """
    finite, covariance = True, state.covariance
    if state.factor.shape[0] > 0:
        state.factor[:] = factor / np.sqrt(noise_variance)
    if covariance.upper.shape[0] > 0:
        finite = write_inverse(factor, covariance.upper)
        _scale(covariance.upper, noise_variance)
        covariance.n_pending[0] = 0
    return finite


@compiled
def take_step(
    plant: Plant,
    network: Network,
    theta: Vector,
    prior: Vector,
    ridge: float,
    features: Matrix,
    targets: Matrix,
    normal: Matrix,
) -> bool:
    """Take a damped step to the minimum of ‖e‖² + ridge ‖θ - θ₀‖².

    ``features`` (p, N), ``targets`` (r, N), θ and θ₀ (q,). The Cholesky factor of JᵀJ + ridge I
    before the step is written, (q, q). False, and no step, where rounding has left it indefinite.
    """
    q = theta.shape[0]
    step = np.empty(q)
    if network.kind == ModelKind.MLP:
        squares = normal_equations(network, theta, features, targets, normal, step)
    else:
        grey_box.write_normal_equations(plant, network, theta, features, targets, normal, step)
        squares = grey_box.squared_error(plant, network, theta, features, targets)
    squares += ridge * squared_distance(theta, prior)
    for i in range(q):
        normal[i, i] += ridge
        step[i] += ridge * (prior[i] - theta[i])
    if not factorize(normal):
        return False
    solve(normal, step)
    share, before = 1.0, theta.copy()
    while share >= SMALLEST_SHARE:
        for i in range(q):
            theta[i] = before[i] + share * step[i]
        if network.kind == ModelKind.MLP:
            after = errors_of(network, theta, features, targets)[0]
        else:
            after = grey_box.squared_error(plant, network, theta, features, targets)
        if after + ridge * squared_distance(theta, prior) <= squares * NO_GROWTH:
            return True
        share *= 0.5
    theta[:] = before
    return True


@compiled
def squared_distance(a: Vector, b: Vector) -> float:
    """Return ‖a - b‖²."""
    total = 0.0
    for i in range(a.shape[0]):
        total += squared(a[i] - b[i])
    return total


@compiled
def _scale(upper: Matrix, factor: float) -> None:
    """Multiply the upper triangle of a matrix, (q, q)."""
    for i in range(upper.shape[0]):
        for j in range(i, upper.shape[0]):
            upper[i, j] *= factor
