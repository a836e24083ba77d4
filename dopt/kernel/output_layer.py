"""Inputs of the output layer of a network in compiled code, and derivatives through them.

They are the last hidden layer h; where inputs of the system multiply it
(:class:`dopt.models.AffineMLP`), they are (h, h u₁, ..., h u_m, u) with u the last features.
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled, contracted, copy_into
from dopt.kernel.structs import Network
from dopt.types import Matrix, Real, Vector


@compiled
def output_inputs(network: Network, hidden: Real, inputs: Real) -> Real:
    """Return the inputs of the output layer, (·, n), for the last hidden layer, (w, n).

    ``inputs`` (p, n) are the features.
    """
    m = network.n_factors
    if m == 0:
        return hidden
    w, n = hidden.shape
    first = inputs.shape[0] - m
    out = np.empty(((1 + m) * w + m, n), hidden.dtype)
    for i in range(w):
        for s in range(n):
            out[i, s] = hidden[i, s]
    for j in range(m):
        for s in range(n):
            u = inputs[first + j, s]
            out[(1 + m) * w + j, s] = u
            for i in range(w):
                out[(1 + j) * w + i, s] = hidden[i, s] * u
    return out


@compiled
def sum_over_factors(m: int, slopes: Matrix, inputs: Matrix, out: Matrix) -> None:
    """Write derivatives by the last hidden layer, (w, n), given those by :func:`output_inputs`."""
    w, n = out.shape
    first = inputs.shape[0] - m
    for i in range(w):
        for s in range(n):
            out[i, s] = slopes[i, s]
        for j in range(m):
            for s in range(n):
                out[i, s] += inputs[first + j, s] * slopes[(1 + j) * w + i, s]


@compiled
def output_inputs_at(network: Network, hidden: Vector, phi: Vector) -> Vector:
    """Return the inputs of the output layer at one point, given its last hidden layer, (w,)."""
    if network.n_factors == 0:
        return hidden
    return output_inputs(network, hidden.reshape(-1, 1), phi.reshape(-1, 1))[:, 0].copy()


@contracted
def output_slope(network: Network, W: Matrix, phi: Vector, component: int, i: int) -> float:
    """Return the derivative of output k by unit i of the last hidden layer; W is its weights."""
    m, w = network.n_factors, network.sizes[1]
    slope: float = W[component, i]
    for j in range(m):
        slope += phi[phi.shape[0] - m + j] * W[component, (1 + j) * w + i]
    return slope


@compiled
def output_inputs_along(
    network: Network, hidden: Vector, hidden_dot: Vector, phi: Vector, phi_dot: Vector
) -> Vector:
    """Return the derivative of :func:`output_inputs_at` along a direction."""
    m, w = network.n_factors, hidden.shape[0]
    if m == 0:
        return hidden_dot
    first = phi.shape[0] - m
    out = np.empty((1 + m) * w + m)
    copy_into(hidden_dot, out[:w])
    for j in range(m):
        u, u_dot = phi[first + j], phi_dot[first + j]
        out[(1 + m) * w + j] = u_dot
        for i in range(w):
            out[(1 + j) * w + i] = hidden_dot[i] * u + hidden[i] * u_dot
    return out
