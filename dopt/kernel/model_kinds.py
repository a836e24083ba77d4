"""Random features and grey boxes in compiled code.

Random features: combinations W ψ(x) of D given functions of the state. Random Fourier features are
ψ(x) = c cos(Ω φ(x) + b), with φ the features of the state; a linear map of the features has ψ = φ.
The learned parameters are the entries of W, row by row: row k of J has ψ at the places k D to
(k + 1) D and zeros elsewhere.

Grey box (:mod:`dopt.models.linear`): its features are the point itself, so that learners keep
points of samples.

======  ==================================================================  =====
symbol  meaning                                                             shape
======  ==================================================================  =====
p       all constants of the equations, θ in the places of the unknown
J       ∂a/∂θ at a point: the derivatives by the unknown constants          r × q
======  ==================================================================  =====
"""

from __future__ import annotations

import math

import numpy as np

from dopt.algorithm import ModelKind
from dopt.kernel.compiler import compiled, copy_into, squared
from dopt.kernel.network import features_at
from dopt.kernel.network_gradients import features_along
from dopt.kernel.structs import Network, Plant
from dopt.types import Integers, Matrix, Vector


@compiled
def n_functions(network: Network) -> int:
    """Return D."""
    linear = network.kind == ModelKind.LINEAR_STATE
    count: int = network.sizes[0] if linear else network.waves.phases.shape[0]
    return count


@compiled
def write_feature_rows(network: Network, x: Vector, rows: Matrix) -> None:
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
def write_feature_row_along(
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


STEP = 1e-30
"""Imaginary part of a complex step: its square is nothing beside any number."""

DIFFERENCE = 2e-5
"""Change of a point, relative to its size and 1, over which J is differentiated along it."""


@compiled
def constants_with(plant: Plant, network: Network, theta: Vector) -> Vector:
    """Return p: the plant's constants with θ in the places of the unknown."""
    constants = plant.parameters.copy()
    for j in range(theta.shape[0]):
        constants[network.unknown[j]] = theta[j]
    return constants


@compiled
def write_constant_rows(
    plant: Plant, x: Vector, constants: Vector, unknown: Integers, rows: Matrix
) -> None:
    """Write the derivatives of the accelerations at a point by some constants, (r, q).

    By a complex step through the equations themselves: exact to rounding.
    """
    z, value = x.astype(np.complex128), np.empty(rows.shape[0], np.complex128)
    stepped = constants.astype(np.complex128)
    for j in range(unknown.shape[0]):
        stepped[unknown[j]] += 1j * STEP
        plant.complex_accelerations(z, stepped, value)
        stepped[unknown[j]] = constants[unknown[j]]
        for k in range(rows.shape[0]):
            rows[k, j] = value[k].imag / STEP


@compiled
def write_rows_along(
    plant: Plant, network: Network, theta: Vector, x: Vector, direction: Vector, out: Matrix
) -> None:
    """Write the derivative of J, (r, q), along a direction of the point, by central differences.

    Their error is of fourth order in the step.
    """
    constants, rows = constants_with(plant, network, theta), np.empty(out.shape)
    out[:] = 0.0
    share = np.inf
    for i in range(direction.shape[0]):
        if direction[i] != 0.0:
            share = min(share, max(1.0, abs(x[i])) / abs(direction[i]))
    if not np.isfinite(share):
        return
    step = DIFFERENCE * share
    for moved, weight in ((2.0, -1.0), (1.0, 8.0), (-1.0, -8.0), (-2.0, 1.0)):
        at = x + moved * step * direction
        write_constant_rows(plant, at, constants, network.unknown, rows)
        out += weight / (12.0 * step) * rows


@compiled
def write_values(
    plant: Plant, network: Network, theta: Vector, points: Matrix, outputs: Matrix
) -> None:
    """Write a_θ, (r, N), at points one to a column, (d or d + m, N)."""
    constants, value = constants_with(plant, network, theta), np.empty(outputs.shape[0])
    for n in range(outputs.shape[1]):
        plant.accelerations(points[:, n].copy(), constants, value)
        outputs[:, n] = value


@compiled
def squared_error(
    plant: Plant, network: Network, theta: Vector, points: Matrix, targets: Matrix
) -> float:
    """Return Σ ‖y - a_θ‖² over points, (·, N), with observed accelerations y, (r, N)."""
    outputs, total = np.empty(targets.shape), 0.0
    write_values(plant, network, theta, points, outputs)
    for k in range(targets.shape[0]):
        for n in range(targets.shape[1]):
            total += squared(targets[k, n] - outputs[k, n])
    return total


@compiled
def write_normal_equations(
    plant: Plant,
    network: Network,
    theta: Vector,
    points: Matrix,
    targets: Matrix,
    normal: Matrix,
    slope: Vector,
) -> None:
    """Write ΣJᵀJ, (q, q), and ΣJᵀ(y - a_θ), (q,), over points, (·, N), with y, (r, N)."""
    constants, outputs = constants_with(plant, network, theta), np.empty(targets.shape)
    rows = np.empty((targets.shape[0], theta.shape[0]))
    write_values(plant, network, theta, points, outputs)
    normal[:] = 0.0
    slope[:] = 0.0
    for n in range(targets.shape[1]):
        write_constant_rows(plant, points[:, n].copy(), constants, network.unknown, rows)
        for k in range(rows.shape[0]):
            error = targets[k, n] - outputs[k, n]
            for i in range(rows.shape[1]):
                slope[i] += rows[k, i] * error
                for j in range(rows.shape[1]):
                    normal[i, j] += rows[k, i] * rows[k, j]
