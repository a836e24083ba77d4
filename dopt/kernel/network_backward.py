"""Backward passes of the network in compiled code: derivatives by pre-activations and parameters.

δ and h are those of :mod:`dopt.kernel.network`.
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled, contracted, squared
from dopt.kernel.network import layer, through_tanh, units_by_points
from dopt.kernel.output_layer import output_inputs_at, output_slope
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
