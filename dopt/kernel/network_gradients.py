"""Derivatives of networks in compiled code: by pre-activations, by parameters, along a direction.

δ and h have the meaning of :mod:`dopt.kernel.network`. Derivatives along a direction of the point
are taken forward over reverse: a dot marks them.
"""

from __future__ import annotations

import math

import numpy as np

from dopt.algorithm import FeatureKind
from dopt.kernel.compiler import compiled, copy_into, squared
from dopt.kernel.network import (
    layer,
    multiply_vector,
    output_inputs_along,
    output_inputs_at,
    output_slopes,
    through_tanh,
    units_by_points,
)
from dopt.kernel.structs import Network
from dopt.kernel.vectors import add_multiple, add_product, multiply
from dopt.types import Matrix, Stack, Vector


@compiled
def output_signal(
    network: Network, theta: Vector, phi: Vector, hidden: Matrix, component: int, delta: Vector
) -> None:
    """Write δ, (w,), of the last hidden layer: the derivative of output k."""
    output_slopes(network, theta, phi, component, delta)
    _through_tanh(delta, hidden[hidden.shape[0] - 1])


@compiled
def _through_tanh(delta: Vector, h: Vector) -> None:
    for i in range(delta.shape[0]):
        delta[i] *= 1.0 - squared(h[i])


@compiled
def back_signals(
    network: Network, theta: Vector, phi: Vector, hidden: Matrix, signals: Stack
) -> None:
    """Write δ, (r, L, w): the derivative of each output with respect to every pre-activation."""
    depth = network.offsets.shape[0] - 1
    for k in range(signals.shape[0]):
        output_signal(network, theta, phi, hidden, k, signals[k, depth - 1])
    for index in range(depth - 1, 0, -1):
        W, _ = layer(network, theta, index)
        multiply(signals[:, index], W, signals[:, index - 1])
        for k in range(signals.shape[0]):
            _through_tanh(signals[k, index - 1], hidden[index - 1])


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
                multiply(W.T, out[k * depth + index + 1], signal)
            through_tanh(signal, h)
    return out


@compiled
def parameter_gradient(
    network: Network, phi: Vector, hidden: Matrix, deltas: Matrix, component: int, out: Vector
) -> None:
    """Write g = ∂a_k/∂θ, (q,): in each layer δ ⊗ (activations below, 1)."""
    depth = network.offsets.shape[0] - 1
    for index in range(depth):
        below = phi if index == 0 else hidden[index - 1]
        dW, db = layer(network, out, index)
        multiply(deltas[index].reshape(-1, 1), below.reshape(1, -1), dW)
        copy_into(deltas[index], db)
    top = output_inputs_at(network, hidden[depth - 1], phi)
    _write_output_row(network, top, 1.0, component, out)


@compiled
def _write_output_row(
    network: Network, top: Vector, one: float, component: int, out: Vector
) -> None:
    """Write the part of the output layer, (top, one) in the row of output k and zeros elsewhere."""
    dW, db = layer(network, out, network.offsets.shape[0] - 1)
    for k in range(db.shape[0]):
        db[k] = one if k == component else 0.0
        if k != component:
            for j in range(dW.shape[1]):
                dW[k, j] = 0.0
    copy_into(top, dW[component])


@compiled
def features_along(network: Network, x: Vector, direction: Vector, out: Vector) -> None:
    """Write the derivative of the features along a direction of the point."""
    for i in range(out.shape[0]):
        index = network.feature_indices[i]
        kind = network.feature_kinds[i]
        slope = 1.0
        if kind == FeatureKind.COS:
            slope = -math.sin(x[index])
        elif kind == FeatureKind.SIN:
            slope = math.cos(x[index])
        out[i] = slope * direction[index] / network.feature_scales[i]


@compiled
def activations_along(
    network: Network, theta: Vector, phi_dot: Vector, hidden: Matrix, hidden_dot: Matrix
) -> None:
    """Write the derivative of the activations, (L, w), along a direction."""
    below = phi_dot
    for index in range(hidden.shape[0]):
        W, _ = layer(network, theta, index)
        multiply_vector(W, below, hidden_dot[index])
        _through_tanh(hidden_dot[index], hidden[index])
        below = hidden_dot[index]


@compiled
def output_signal_along(
    network: Network,
    theta: Vector,
    phi: Vector,
    phi_dot: Vector,
    hidden: Matrix,
    hidden_dot: Matrix,
    component: int,
    delta_dot: Vector,
) -> None:
    """Write the derivative of δ, (w,), of the last hidden layer along a direction."""
    depth, width, m = network.offsets.shape[0] - 1, hidden.shape[1], network.n_factors
    h, h_dot = hidden[depth - 1], hidden_dot[depth - 1]
    output_slopes(network, theta, phi, component, delta_dot)
    for i in range(width):
        delta_dot[i] *= -2.0 * h[i] * h_dot[i]
    if m == 0:
        return
    weights, slopes = layer(network, theta, depth)[0][component], np.zeros(width)
    for j in range(m):
        u_dot = phi_dot[phi_dot.shape[0] - m + j]
        add_multiple(slopes, u_dot, weights[(1 + j) * width : (2 + j) * width])
    for i in range(width):
        delta_dot[i] += slopes[i] * (1.0 - squared(h[i]))


@compiled
def signals_below(
    network: Network,
    theta: Vector,
    hidden: Matrix,
    hidden_dots: Stack,
    signals: Stack,
) -> None:
    """Write δ and its derivatives along m directions, (1 + m, L, w), given the last layer's."""
    for index in range(hidden.shape[0] - 1, 0, -1):
        W, _ = layer(network, theta, index)
        multiply(signals[:, index], W, signals[:, index - 1])
        back, h = signals[0, index - 1], hidden[index - 1]
        for k in range(hidden_dots.shape[0]):
            delta_dot, hidden_dot = signals[1 + k, index - 1], hidden_dots[k, index - 1]
            _through_tanh(delta_dot, h)
            for j in range(back.shape[0]):
                delta_dot[j] += back[j] * (-2.0 * h[j] * hidden_dot[j])
        _through_tanh(back, h)


@compiled
def gradient_along(
    network: Network,
    phi: Vector,
    phi_dot: Vector,
    hidden: Matrix,
    hidden_dot: Matrix,
    deltas: Matrix,
    deltas_dot: Matrix,
    component: int,
    out: Vector,
) -> None:
    """Write the derivative of g, (q,), along a direction: one column of D B."""
    depth = network.offsets.shape[0] - 1
    for index in range(depth):
        below = phi if index == 0 else hidden[index - 1]
        below_dot = phi_dot if index == 0 else hidden_dot[index - 1]
        dW, db = layer(network, out, index)
        multiply(deltas_dot[index].reshape(-1, 1), below.reshape(1, -1), dW)
        add_product(deltas[index].reshape(-1, 1), below_dot.reshape(1, -1), dW)
        copy_into(deltas_dot[index], db)
    top_dot = output_inputs_along(network, hidden[depth - 1], hidden_dot[depth - 1], phi, phi_dot)
    _write_output_row(network, top_dot, 0.0, component, out)
