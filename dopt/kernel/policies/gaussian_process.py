"""Predictive entropy in compiled code (:mod:`dopt.policies.held_candidates`).

Legend beside :mod:`dopt.kernel.structs`: C candidates, H steps for which one is held, n samples
taken, L their Cholesky factor (:mod:`dopt.kernel.learners.conditioning`).
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.gaussian_process import (
    mean_weights,
    sample_features,
    write_combination,
    write_kernel,
    write_mean,
)
from dopt.kernel.information.cholesky import factorize, solve_lower
from dopt.kernel.information.primal import inner
from dopt.kernel.model import euler_step
from dopt.kernel.network import features_at
from dopt.kernel.structs import Network, Trial
from dopt.types import Matrix, Vector


@compiled
def plan(trial: Trial, t: int, u: Vector) -> None:
    """Write the candidate of the largest entropy, (m,); of equal ones the first."""
    search, posterior = trial.algorithm.search, trial.state.posterior
    C, H, n = search.candidates.shape[0], search.steps, posterior.n_samples[0]
    visited = np.empty((C * H, trial.network.sizes[0]))
    rows = np.empty((C * H, n))
    _write_paths(trial, t, visited, rows)
    solve_lower(posterior.factor, n, rows)
    best = -np.inf
    u[:] = search.candidates[0]
    for c in range(C):
        own = slice(c * H, (c + 1) * H)
        value = _entropy(trial.network, visited[own], rows[own])
        if value > best:
            best = value
            u[:] = search.candidates[c]


@compiled
def _write_paths(trial: Trial, t: int, visited: Matrix, rows: Matrix) -> None:
    """Write the features of the states that the candidates lead to, (C H, p), path by path.

    Their kernel with the samples, (C H, n), is written as well.
    """
    plant, network, search = trial.plant, trial.network, trial.algorithm.search
    theta, n, r = trial.state.theta, rows.shape[1], plant.learned_rows.shape[0]
    phi, alpha = sample_features(network, theta, r)[:n], mean_weights(network, theta, r)[:n]
    first, value = np.empty(r), np.empty(r)
    d = trial.record.states.shape[1]
    x, flow, following = np.empty(d), np.empty(d), np.empty(d)
    write_mean(network, theta, trial.record.states[t], first)
    for c in range(search.candidates.shape[0]):
        x[:] = trial.record.states[t]
        value[:] = first
        for i in range(c * search.steps, (c + 1) * search.steps):
            euler_step(plant, x, search.candidates[c], value, flow, following)
            x[:] = following
            features_at(network, x, visited[i])
            write_kernel(network, visited[i], phi, rows[i])
            write_combination(rows[i], alpha, value)


@compiled
def _entropy(network: Network, phi: Matrix, whitened: Matrix) -> float:
    """Return log det of the covariance of observations at features (H, p), given L⁻¹k, (H, n).

    It is -∞ where rounding has left the covariance indefinite.
    """
    H = phi.shape[0]
    covariance = np.empty((H, H))
    for i in range(H):
        write_kernel(network, phi[i], phi, covariance[i])
        for j in range(H):
            covariance[i, j] -= inner(whitened[i], whitened[j])
        covariance[i, i] += network.process.noise_variance
    if not factorize(covariance):
        return -np.inf
    total = 0.0
    for i in range(H):
        total += 2.0 * np.log(covariance[i, i])
    return total
