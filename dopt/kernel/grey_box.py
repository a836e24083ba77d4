"""Equations of a system with unknown constants in compiled code (:mod:`dopt.models.grey_box`).

The features of a grey box are the point itself: what learners keep of samples are their points.

======  ==================================================================  =====
symbol  meaning                                                             shape
======  ==================================================================  =====
p       all constants of the equations, θ in the places of the unknown
J       ∂a/∂θ at a point: the derivatives by the unknown constants          r × q
======  ==================================================================  =====
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled, squared
from dopt.kernel.structs import Network, Plant
from dopt.types import Integers, Matrix, Vector

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
