"""Conditioning of a Gaussian process in compiled code (:mod:`dopt.learning.least_squares`).

======  =====================================================  =====
symbol  meaning                                                shape
======  =====================================================  =====
L       Cholesky factor of K + σ²/dt I of n samples            n × n
z       L⁻¹ Y, with Y the observed accelerations               n × r
α       L⁻ᵀ z, weights of the posterior mean                   n × r
======  =====================================================  =====
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.gaussian_process import mean_weights, sample_features, write_kernel
from dopt.kernel.information.cholesky import solve_lower, solve_lower_transposed
from dopt.kernel.information.primal import inner
from dopt.kernel.network import features_at
from dopt.kernel.points import sampled_state
from dopt.kernel.state_structs import Posterior
from dopt.kernel.structs import Network, Trial
from dopt.types import Vector


@compiled
def learn(trial: Trial, t: int, target: Vector) -> None:
    """Add the sample of step t, whose accelerations are (r,): a row of L and of z, and all of α."""
    network, posterior, r = trial.network, trial.state.posterior, target.shape[0]
    n = posterior.n_samples[0]
    phi = sample_features(network, trial.state.theta, r)
    features_at(network, sampled_state(trial.plant, trial.record.states, t), phi[n])
    write_kernel(network, phi[n], phi[:n], posterior.factor[n, :n])
    _grow(network, posterior, target)
    alpha = mean_weights(network, trial.state.theta, r)
    columns = np.empty((r, n + 1))
    columns[:] = posterior.solved[: n + 1].T
    solve_lower_transposed(posterior.factor, n + 1, columns)
    alpha[: n + 1] = columns.T


@compiled
def _grow(network: Network, posterior: Posterior, target: Vector) -> None:
    """Turn row n of L, which holds the kernel with the n samples, into itself; add a row to z."""
    n, process = posterior.n_samples[0], network.process
    solve_lower(posterior.factor, n, posterior.factor[n : n + 1])
    row = posterior.factor[n, :n]
    # The variance of a new observation is that of its noise at least.
    rest = process.amplitude * process.amplitude + process.noise_variance - inner(row, row)
    deviation = np.sqrt(max(rest, process.noise_variance))
    posterior.factor[n, n] = deviation
    for k in range(target.shape[0]):
        known = 0.0
        for i in range(n):
            known += row[i] * posterior.solved[i, k]
        posterior.solved[n, k] = (target[k] - known) / deviation
    posterior.n_samples[0] = n + 1
