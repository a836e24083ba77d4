"""Root mean square error of the model over the evaluation points, in compiled code."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.algorithm import ModelKind
from dopt.kernel.compiler import compiled
from dopt.kernel.gaussian_process import mean_weights
from dopt.kernel.model import write_values
from dopt.kernel.network import mean_forward
from dopt.kernel.structs import Evaluation, Network, Plant
from dopt.kernel.vectors import inner, multiply
from dopt.types import Matrix, Real, Singles, Vector

BLOCK = 256
"""Points evaluated at a time: the activations of a block stay in the first-level cache."""

SINGLE_FLOOR = 1e-2
"""Least loss, in units of the root mean square of the targets, that single precision settles.

Rounding the network's values to single precision moves each of them by about 1e-7 of the targets'
size, hence the loss by less than 1e-5 of itself above this floor (tested); below, the loss is
evaluated in double precision.
"""


class Buffers(NamedTuple):
    """Scratch memory of an evaluation.

    Flat activations, (L, w BLOCK), and outputs of a block, (r, BLOCK), of the mean and of a member.
    """

    single: tuple[Singles, Singles, Singles]
    double: tuple[Matrix, Matrix, Matrix]
    thetas: Singles  # (E, q)


@compiled
def model_error(
    plant: Plant,
    network: Network,
    thetas: Matrix,
    points: Evaluation,
    start: int,
    stop: int,
    buffers: Buffers,
) -> float:
    """Return sqrt(mean ‖a_θ(x) - a(x)‖²) over the blocks of points from ``start`` to ``stop``.

    Parameters ``thetas``, (E, q), of more than one network stand for the mean of what they give.
    For the linear model both bounds count points (:attr:`Evaluation.bounds`).
    """
    theta = thetas[0]
    if network.kind == ModelKind.LINEAR:
        return _linear_error(theta, points, start, stop)
    if network.kind != ModelKind.MLP:
        outputs = buffers.double[1]
        return _other_error(plant, network, theta, points, start, stop, outputs)
    single = buffers.thetas
    for k in range(thetas.shape[0]):
        for i in range(thetas.shape[1]):
            single[k, i] = np.float32(thetas[k, i])
    loss = _network_error(network, single, points.single, points, start, stop, buffers.single)
    if loss >= SINGLE_FLOOR * points.target_size:
        return loss
    return _network_error(network, thetas, points.features, points, start, stop, buffers.double)


@compiled
def _network_error(
    network: Network,
    thetas: Real,
    features: Real,
    points: Evaluation,
    start: int,
    stop: int,
    memory: tuple[Real, Real, Real],
) -> float:
    hidden, outputs, one = memory
    total, count = 0.0, 0
    for block in range(start, stop):
        mean_forward(network, thetas, features[block], hidden, outputs, one)
        used = points.block_sizes[block]
        total += _squared_errors(outputs, points.block_targets[block], used)
        count += used
    return float(np.sqrt(total / count)) if count else np.nan


@compiled
def _other_error(
    plant: Plant,
    network: Network,
    theta: Vector,
    points: Evaluation,
    start: int,
    stop: int,
    outputs: Matrix,
) -> float:
    """Return the error of a grey box, of means of processes, or of functions of a basis."""
    total, count, n, r = 0.0, 0, points.n_basis[0], outputs.shape[0]
    for block in range(start, stop):
        used = points.block_sizes[block]
        if network.kind == ModelKind.GREY_BOX:
            at = points.features[block, :, :used]
            write_values(plant, network, theta, at, outputs[:, :used])
        elif network.kind == ModelKind.GAUSSIAN_PROCESS:
            G = points.basis.shape[0] // points.bounds[2]
            alpha, rows = mean_weights(network, theta, r)[:, :n], r // G
            for g in range(G):  # each kernel has a basis
                out = outputs[g * rows : (g + 1) * rows]
                multiply(alpha[g * rows : (g + 1) * rows], points.basis[G * block + g, :n], out)
        else:
            W = theta.reshape(r, points.basis.shape[1])
            multiply(W, points.basis[block], outputs)
        total += _squared_errors(outputs, points.block_targets[block], used)
        count += used
    return float(np.sqrt(total / count)) if count else np.nan


@compiled
def _squared_errors(outputs: Real, targets: Matrix, n: int) -> float:
    """Return Σ (output - target)² over the first n columns."""
    total, errors = 0.0, np.empty(n)
    for k in range(outputs.shape[0]):
        values, truth = outputs[k, :n], targets[k, :n]
        for i in range(values.shape[0]):
            errors[i] = values[i] - truth[i]
        total += inner(errors, errors)
    return total


@compiled
def _linear_error(theta: Vector, points: Evaluation, start: int, stop: int) -> float:
    total = 0.0
    for i in range(start, stop):
        for k in range(points.targets.shape[1]):
            value = -points.targets[i, k]
            for j in range(theta.shape[0]):
                value += points.regressors[i, k, j] * theta[j]
            total += value * value
    return float(np.sqrt(total / (stop - start))) if stop > start else np.nan


@compiled
def evaluation_buffers(network: Network, thetas: Matrix, r: int) -> Buffers:
    """Return the scratch memory of :func:`model_error`."""
    depth, room = network.offsets.shape[0] - 1, network.sizes[1] * BLOCK
    single, double = np.float32, np.float64
    return Buffers(
        (
            np.empty((depth, room), single),
            np.empty((r, BLOCK), single),
            np.empty((r, BLOCK), single),
        ),
        (
            np.empty((depth, room), double),
            np.empty((r, BLOCK), double),
            np.empty((r, BLOCK), double),
        ),
        np.empty(thetas.shape, single),
    )


@compiled
def follow_truth(plant: Plant, network: Network, points: Evaluation, t: int) -> None:
    """Write the accelerations that are true at step t into the targets of all points."""
    r = plant.learned_rows.shape[0]
    value, offset = np.empty(r), np.empty(r)
    if network.kind == ModelKind.LINEAR:
        for i in range(points.states.shape[0]):
            plant.accelerations(points.states[i], plant.history[t], value)
            plant.accelerations(points.states[i], plant.linear_form[0], offset)
            for k in range(r):
                points.targets[i, k] = value[k] - offset[k]
        return
    i = 0
    for block in range(points.bounds[2]):
        for j in range(points.block_sizes[block]):
            plant.accelerations(points.states[i], plant.history[t], value)
            i += 1
            for k in range(r):
                points.block_targets[block, k, j] = value[k]
