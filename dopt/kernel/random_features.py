"""Combinations W ψ(x) of D given functions of the state, and their derivatives, in compiled code.

Random Fourier features are ψ(x) = c cos(Ω φ(x) + b), with φ the features of the state; a linear map
of the features has ψ = φ (:mod:`dopt.models.linear`). The learned parameters are the entries of W,
row by row: row k of J has ψ at the places k D to (k + 1) D and zeros
elsewhere.
"""

from __future__ import annotations

import math

import numpy as np

from dopt.algorithm import ModelKind
from dopt.kernel.compiler import compiled, copy_into
from dopt.kernel.network import features_at
from dopt.kernel.network_tangents import features_along
from dopt.kernel.structs import Network
from dopt.types import Matrix, Vector


@compiled
def n_functions(network: Network) -> int:
    """Return D."""
    linear = network.kind == ModelKind.LINEAR_STATE
    count: int = network.sizes[0] if linear else network.waves.phases.shape[0]
    return count


@compiled
def write_rows(network: Network, x: Vector, rows: Matrix) -> None:
    """Write J, (r, r D), at a state."""
    phi, D = np.empty(network.sizes[0]), n_functions(network)
    features_at(network, x, phi)
    rows[:] = 0.0
    for i in range(D):
        if network.kind == ModelKind.LINEAR_STATE:
            value = phi[i]
        else:
            value = network.waves.scale * math.cos(_angle(network, phi, i))
        for k in range(rows.shape[0]):
            rows[k, k * D + i] = value


@compiled
def write_row_along(
    network: Network, x: Vector, direction: Vector, component: int, out: Vector
) -> None:
    """Write the derivative of row ``component`` of J, (r D,), along a direction of the state."""
    phi, phi_dot = np.empty(network.sizes[0]), np.empty(network.sizes[0])
    features_at(network, x, phi)
    features_along(network, x, direction, phi_dot)
    out[:] = 0.0
    first = component * n_functions(network)
    if network.kind == ModelKind.LINEAR_STATE:
        copy_into(phi_dot, out[first : first + phi_dot.shape[0]])
        return
    for i in range(network.waves.phases.shape[0]):
        slope = 0.0
        for j in range(phi_dot.shape[0]):
            slope += network.waves.frequencies[i, j] * phi_dot[j]
        out[first + i] = -network.waves.scale * math.sin(_angle(network, phi, i)) * slope


@compiled
def _angle(network: Network, phi: Vector, i: int) -> float:
    """Return entry i of Ω φ + b."""
    angle: float = network.waves.phases[i]
    for j in range(phi.shape[0]):
        angle += network.waves.frequencies[i, j] * phi[j]
    return angle
