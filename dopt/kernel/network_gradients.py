"""Derivatives of networks in compiled code: by pre-activations, by parameters, along a direction.

δ and h have the meaning of :mod:`dopt.kernel.network`. Derivatives along a direction of the point
are taken forward over reverse: a dot marks them.
"""

from __future__ import annotations

import math

import numpy as np

from dopt.algorithm import FeatureKind
from dopt.kernel.compiler import compiled, contracted, squared
from dopt.kernel.network import (
    add_product,
    layer,
    output_inputs_along,
    output_inputs_at,
    output_slope,
    through_tanh,
    units_by_points,
)
from dopt.kernel.structs import Network
from dopt.types import Matrix, Stack, Vector


@contracted
def output_signal(
    network: Network, theta: Vector, phi: Vector, hidden: Matrix, component: int, delta: Vector
) -> None:
    """Write δ, (w,), of the last hidden layer: the derivative of output k."""
    depth = network.offsets.shape[0] - 1
    W, _ = layer(network, theta, depth)
    for i in range(delta.shape[0]):
        slope = output_slope(network, W, phi, component, i)
        delta[i] = slope * (1.0 - squared(hidden[depth - 1, i]))


@contracted
def signals_through(network: Network, theta: Vector, index: int, signals: Stack) -> None:
    """Write Wᵀ δ below a layer for each of several δ, (n, L, w), each sum in the order of δ.

    The weights are read once.
    """
    W, _ = layer(network, theta, index)
    for k in range(signals.shape[0]):
        below = signals[k, index - 1]
        for j in range(below.shape[0]):
            below[j] = 0.0
    for i in range(W.shape[0]):
        weights = W[i]
        for k in range(signals.shape[0]):
            delta, below = signals[k, index, i], signals[k, index - 1]
            for j in range(below.shape[0]):
                below[j] += delta * weights[j]


@contracted
def back_signals(
    network: Network, theta: Vector, phi: Vector, hidden: Matrix, signals: Stack
) -> None:
    """Write δ, (r, L, w): the derivative of each output with respect to every pre-activation."""
    depth = network.offsets.shape[0] - 1
    for k in range(signals.shape[0]):
        output_signal(network, theta, phi, hidden, k, signals[k, depth - 1])
    for index in range(depth - 1, 0, -1):
        signals_through(network, theta, index, signals)
        for k in range(signals.shape[0]):
            for i in range(signals.shape[2]):
                signals[k, index - 1, i] *= 1.0 - squared(hidden[index - 1, i])


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


@contracted
def activations_along(
    network: Network, theta: Vector, phi_dot: Vector, hidden: Matrix, hidden_dot: Matrix
) -> None:
    """Write the derivative of the activations, (L, w), along a direction."""
    below = phi_dot
    for index in range(hidden.shape[0]):
        W, _ = layer(network, theta, index)
        for i in range(hidden.shape[1]):
            hidden_dot[index, i] = 0.0
        add_product(W, below, hidden_dot[index])
        for i in range(hidden.shape[1]):
            hidden_dot[index, i] *= 1.0 - squared(hidden[index, i])
        below = hidden_dot[index]


@contracted
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
    W, _ = layer(network, theta, depth)
    for i in range(width):
        h = hidden[depth - 1, i]
        bend = -2.0 * h * hidden_dot[depth - 1, i]
        delta_dot[i] = output_slope(network, W, phi, component, i) * bend
        for j in range(m):
            slope = phi_dot[phi_dot.shape[0] - m + j] * W[component, (1 + j) * width + i]
            delta_dot[i] += slope * (1.0 - h * h)


@contracted
def signals_below(
    network: Network,
    theta: Vector,
    hidden: Matrix,
    hidden_dots: Stack,
    signals: Stack,
) -> None:
    """Write δ and its derivatives along m directions, (1 + m, L, w), given the last layer's."""
    for index in range(hidden.shape[0] - 1, 0, -1):
        signals_through(network, theta, index, signals)
        back = signals[0, index - 1]
        for k in range(hidden_dots.shape[0]):
            delta_dot, hidden_dot = signals[1 + k, index - 1], hidden_dots[k, index - 1]
            for j in range(back.shape[0]):
                h = hidden[index - 1, j]
                bend = -2.0 * h * hidden_dot[j]
                delta_dot[j] = delta_dot[j] * (1.0 - h * h) + back[j] * bend
        for j in range(back.shape[0]):
            back[j] *= 1.0 - squared(hidden[index - 1, j])


@contracted
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
        for i in range(db.shape[0]):
            delta, delta_dot = deltas[index, i], deltas_dot[index, i]
            db[i] = delta_dot
            for j in range(dW.shape[1]):
                dW[i, j] = delta_dot * below[j] + delta * below_dot[j]
    dW, db = layer(network, out, depth)
    top_dot = output_inputs_along(network, hidden[depth - 1], hidden_dot[depth - 1], phi, phi_dot)
    for k in range(db.shape[0]):
        chosen = 1.0 if k == component else 0.0
        db[k] = 0.0
        for j in range(dW.shape[1]):
            dW[k, j] = chosen * top_dot[j]
