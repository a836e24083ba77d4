"""Kernel and posterior mean of a Gaussian process in compiled code.

The flat parameters θ of :mod:`dopt.models.linear` hold the features of the T states at
which samples are taken, (T, p), and the weights α of the mean, (T, r). Rows of samples not yet
taken are zero. Here n is the number of samples taken.
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled, squared
from dopt.kernel.network import features_at
from dopt.kernel.structs import Network
from dopt.types import Matrix, Vector


@compiled
def sample_features(network: Network, theta: Vector, r: int) -> Matrix:
    """Return a view of the features of all samples, (T, p)."""
    p = network.sizes[0]
    T = theta.shape[0] // (p + r)
    return theta[: T * p].reshape(T, p)


@compiled
def mean_weights(network: Network, theta: Vector, r: int) -> Matrix:
    """Return a view of the weights α, (T, r)."""
    p = network.sizes[0]
    T = theta.shape[0] // (p + r)
    return theta[T * p :].reshape(T, r)


@compiled
def kernel_value(network: Network, square: float) -> float:
    """Return k for a squared distance of the features."""
    process = network.process
    value: float = squared(process.amplitude) * np.exp(-0.5 / squared(process.lengthscale) * square)
    return value


@compiled
def write_kernel(network: Network, phi: Vector, others: Matrix, out: Vector) -> None:
    """Write k, (n,), between features (p,) and (n, p)."""
    for i in range(others.shape[0]):
        square = 0.0
        for j in range(phi.shape[0]):
            square += squared(phi[j] - others[i, j])
        out[i] = kernel_value(network, square)


@compiled
def write_combination(values: Vector, alpha: Matrix, out: Vector) -> None:
    """Write the sums, (r,), of n kernel values times the weights of their samples, (n, r)."""
    for k in range(out.shape[0]):
        out[k] = 0.0
        for i in range(values.shape[0]):
            out[k] += values[i] * alpha[i, k]


@compiled
def write_mean(network: Network, theta: Vector, x: Vector, out: Vector) -> None:
    """Write the posterior mean, (r,), at a state."""
    others, phi = sample_features(network, theta, out.shape[0]), np.empty(network.sizes[0])
    values = np.empty(others.shape[0])
    features_at(network, x, phi)
    write_kernel(network, phi, others, values)
    write_combination(values, mean_weights(network, theta, out.shape[0]), out)
