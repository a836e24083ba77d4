"""The model in compiled code: values and gradients, for batches and single states.

Twin of the ``torch.nn.Module`` of the reference. In the backward passes δ is the derivative of an
output with respect to the pre-activations of a layer, and h the activations. The output layer has
the last hidden layer for its inputs, and with it the inputs of the system where they multiply it
(:mod:`dopt.kernel.output_layer`).
"""

from __future__ import annotations

import math

import numpy as np

from dopt.algorithm import FeatureKind
from dopt.kernel.compiler import compiled, contracted, squared, vectorized
from dopt.kernel.output_layer import (
    output_inputs,
    output_inputs_at,
    output_slope,
    sum_over_factors,
)
from dopt.kernel.structs import Network
from dopt.kernel.tanh import tanh
from dopt.types import Matrix, Real, Stack, Vector


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
        _affine(W, b, below, values)
        for i in range(values.shape[0]):
            values[i] = tanh(values[i])
        below = values
    W, b = layer(network, theta, depth)
    _affine(W, b, output_inputs_at(network, below, phi), output)


@contracted
def _affine(W: Matrix, b: Vector, x: Vector, out: Vector) -> None:
    for i in range(out.shape[0]):
        total = b[i]
        for j in range(W.shape[1]):
            total += W[i, j] * x[j]
        out[i] = total


@contracted
def transposed_product(W: Matrix, delta: Vector, out: Vector) -> None:
    for j in range(out.shape[0]):
        out[j] = 0.0
    for i in range(delta.shape[0]):
        for j in range(out.shape[0]):
            out[j] += delta[i] * W[i, j]


@contracted
def back_signals(
    network: Network, theta: Vector, phi: Vector, hidden: Matrix, component: int, deltas: Matrix
) -> None:
    """Write δ, (L, w): the derivative of output k with respect to every pre-activation."""
    depth = network.offsets.shape[0] - 1
    W, _ = layer(network, theta, depth)
    for i in range(deltas.shape[1]):
        slope = output_slope(network, W, phi, component, i)
        deltas[depth - 1, i] = slope * (1.0 - squared(hidden[depth - 1, i]))
    for index in range(depth - 1, 0, -1):
        W, _ = layer(network, theta, index)
        transposed_product(W, deltas[index], deltas[index - 1])
        for i in range(deltas.shape[1]):
            deltas[index - 1, i] *= 1.0 - squared(hidden[index - 1, i])


@compiled
def batch_back_signals(
    network: Network, theta: Vector, inputs: Matrix, hidden: Matrix, r: int
) -> Stack:
    """Return δ of every output and hidden layer, (r L, w, N), layer by layer of an output.

    ``inputs`` (p, N) are features, ``hidden`` (L, w N) the activations there.
    """
    n, m, p = inputs.shape[1], network.n_factors, inputs.shape[0]
    depth, width = network.offsets.shape[0] - 1, network.sizes[1]
    out = np.empty((r * depth, width, n))
    last, _ = layer(network, theta, depth)
    for k in range(r):
        for index in range(depth - 1, -1, -1):
            h = units_by_points(hidden[index], width, n)
            signal = out[k * depth + index]
            if index == depth - 1:
                for i in range(width):
                    signal[i] = last[k, i]
                    for j in range(m):
                        signal[i] += inputs[p - m + j] * last[k, (1 + j) * width + i]
            else:
                W, _ = layer(network, theta, index + 1)
                np.dot(W.T, out[k * depth + index + 1], signal)
            through_tanh(signal, h)
    return out


@contracted
def parameter_gradient(
    network: Network, phi: Vector, hidden: Matrix, deltas: Matrix, component: int, out: Vector
) -> None:
    """Write g = ∂a_k/∂θ, (q,): in each layer δ ⊗ (activations below, 1)."""
    depth = network.offsets.shape[0] - 1
    for index in range(depth):
        below = phi if index == 0 else hidden[index - 1]
        dW, db = layer(network, out, index)
        for i in range(db.shape[0]):
            delta = deltas[index, i]
            db[i] = delta
            for j in range(dW.shape[1]):
                dW[i, j] = delta * below[j]
    dW, db = layer(network, out, depth)
    top = output_inputs_at(network, hidden[depth - 1], phi)
    for k in range(db.shape[0]):
        chosen = 1.0 if k == component else 0.0
        db[k] = chosen
        for j in range(dW.shape[1]):
            dW[k, j] = chosen * top[j]
