"""The model in compiled code: values and gradients, for batches and single states.

In the backward passes δ is the derivative of an
output with respect to the pre-activations of a layer, and h the activations. The output layer has
the last hidden layer for its inputs, and with it the inputs of the system where they multiply it
(:mod:`dopt.kernel.output_layer`).
"""

from __future__ import annotations

import math

import numpy as np

from dopt.algorithm import FeatureKind
from dopt.kernel.compiler import compiled, contracted, copy_into, vectorized
from dopt.kernel.output_layer import (
    output_inputs,
    output_inputs_at,
    sum_over_factors,
)
from dopt.kernel.structs import Network
from dopt.kernel.tanh import tanh
from dopt.types import Matrix, Real, Vector


@compiled
def features_at(network: Network, x: Vector, out: Vector) -> None:
    """Write the features of a point."""
    for i in range(out.shape[0]):
        value = x[network.feature_indices[i]]
        kind = network.feature_kinds[i]
        if kind == FeatureKind.COS:
            value = math.cos(value)
        elif kind == FeatureKind.SIN:
            value = math.sin(value)
        out[i] = value / network.feature_scales[i]


@compiled
def write_feature(network: Network, index: int, values: Vector, out: Vector) -> None:
    """Write one feature of points, (N,), given the component that it is made of, (N,)."""
    kind, scale = network.feature_kinds[index], network.feature_scales[index]
    for n in range(values.shape[0]):
        value = values[n]
        if kind == FeatureKind.COS:
            value = math.cos(value)
        elif kind == FeatureKind.SIN:
            value = math.sin(value)
        out[n] = value / scale


@compiled
def layer(network: Network, theta: Real, index: int) -> tuple[Real, Real]:
    """Return views of the weights, (outputs, inputs), and biases of a layer."""
    n_in, n_out = network.layer_inputs[index], network.sizes[index + 1]
    start = network.offsets[index]
    middle = start + n_in * n_out
    return theta[start:middle].reshape(n_out, n_in), theta[middle : middle + n_out]


@contracted
def _activate(values: Real, bias: Real) -> None:
    for i in range(values.shape[0]):
        row, shift = values[i], bias[i]
        for n in range(row.shape[0]):
            row[n] = tanh(row[n] + shift)


@compiled
def units_by_points(buffer: Real, units: int, n: int) -> Real:
    """Return the start of a flat buffer as a matrix, (units, n)."""
    return buffer[: units * n].reshape(units, n)


@compiled
def forward(network: Network, theta: Real, inputs: Real, hidden: Real, outputs: Real) -> None:
    """Evaluate the network at n points, one to a column so that each unit's row is contiguous.

    ``inputs`` (p, n), ``hidden`` (L, at least w n) of flat buffers, ``outputs`` (r, n); the last
    two are written.
    """
    n, depth, width = inputs.shape[1], network.offsets.shape[0] - 1, network.sizes[1]
    W, b = layer(network, theta, 0)
    values = units_by_points(hidden[0], width, n)
    np.dot(W, inputs[: W.shape[1]], values)
    _activate(values, b)
    for index in range(1, depth):
        W, b = layer(network, theta, index)
        above = units_by_points(hidden[index], width, n)
        np.dot(W, values, above)
        _activate(above, b)
        values = above
    W, b = layer(network, theta, depth)
    np.dot(W, output_inputs(network, values, inputs), outputs)
    for k in range(b.shape[0]):
        for i in range(n):
            outputs[k, i] += b[k]


@compiled
def mean_forward(
    network: Network, thetas: Real, inputs: Real, hidden: Real, outputs: Real, one: Real
) -> None:
    """Evaluate the mean of networks with parameters (E, q) as :func:`forward` does one.

    ``one`` (r, n) is scratch memory.
    """
    forward(network, thetas[0], inputs, hidden, outputs)
    if thetas.shape[0] == 1:
        return
    for k in range(1, thetas.shape[0]):
        forward(network, thetas[k], inputs, hidden, one)
        for i in range(outputs.shape[0]):
            for n in range(outputs.shape[1]):
                outputs[i, n] += one[i, n]
    for i in range(outputs.shape[0]):
        for n in range(outputs.shape[1]):
            outputs[i, n] /= thetas.shape[0]


@vectorized
def _row_sums(values: Matrix, out: Vector) -> None:
    for i in range(out.shape[0]):
        row, total = values[i], 0.0
        for n in range(row.shape[0]):
            total += row[n]
        out[i] = total


@contracted
def through_tanh(delta: Matrix, activations: Matrix) -> None:
    """Multiply δ, (w, n), by the derivative of tanh, given the activations, (w, n)."""
    for i in range(delta.shape[0]):
        row, h = delta[i], activations[i]
        for n in range(row.shape[0]):
            row[n] *= 1.0 - h[n] * h[n]


@compiled
def loss_gradient(
    network: Network,
    theta: Vector,
    inputs: Matrix,
    targets: Matrix,
    hidden: Matrix,
    deltas: Matrix,
    gradient: Vector,
) -> None:
    """Write the gradient of mean_n ‖a_θ(x_n) - y_n‖² over a batch, (q,).

    ``inputs`` (p, n), ``targets`` (r, n); ``hidden`` (L, ·) and ``deltas`` (3, ·) are flat scratch
    buffers of at least max(w, r) n entries each.
    """
    n, depth, width = inputs.shape[1], network.offsets.shape[0] - 1, network.sizes[1]
    errors = units_by_points(deltas[2], targets.shape[0], n)
    forward(network, theta, inputs, hidden, errors)
    for k in range(errors.shape[0]):
        for i in range(n):
            errors[k, i] = 2.0 / n * (errors[k, i] - targets[k, i])
    delta = errors
    for index in range(depth, -1, -1):
        dW, db = layer(network, gradient, index)
        _row_sums(delta, db)
        if index == 0:
            np.dot(delta, inputs[: dW.shape[1]].T, dW)
        else:
            W, _ = layer(network, theta, index)
            values = units_by_points(hidden[index - 1], width, n)
            below = units_by_points(deltas[index % 2], width, n)
            if index == depth and network.n_factors > 0:
                np.dot(delta, output_inputs(network, values, inputs).T, dW)
                sum_over_factors(network.n_factors, np.dot(W.T, delta), inputs, below)
            else:
                np.dot(delta, values.T, dW)
                np.dot(W.T, delta, below)
            through_tanh(below, values)
            delta = below


@contracted
def activations_at(
    network: Network, theta: Vector, phi: Vector, hidden: Matrix, output: Vector
) -> None:
    """Evaluate the network at one point: ``hidden`` (L, w) and ``output`` (r,) are written."""
    depth = network.offsets.shape[0] - 1
    below = phi
    for index in range(depth):
        W, b = layer(network, theta, index)
        values = hidden[index]
        copy_into(b, values)
        add_product(W, below, values)
        for i in range(values.shape[0]):
            values[i] = tanh(values[i])
        below = values
    W, b = layer(network, theta, depth)
    copy_into(b, output)
    add_product(W, output_inputs_at(network, below, phi), output)


@contracted
def add_product(W: Matrix, x: Vector, out: Vector) -> None:
    """Add W x, each sum in the order of x.

    Four sums are taken at once, as the next term of one has to wait for the last.
    """
    whole = out.shape[0] - out.shape[0] % 4
    for i in range(0, whole, 4):
        sum_0, sum_1, sum_2, sum_3 = out[i], out[i + 1], out[i + 2], out[i + 3]
        for j in range(W.shape[1]):
            sum_0 += W[i, j] * x[j]
            sum_1 += W[i + 1, j] * x[j]
            sum_2 += W[i + 2, j] * x[j]
            sum_3 += W[i + 3, j] * x[j]
        out[i], out[i + 1], out[i + 2], out[i + 3] = sum_0, sum_1, sum_2, sum_3
    for i in range(whole, out.shape[0]):
        for j in range(W.shape[1]):
            out[i] += W[i, j] * x[j]
