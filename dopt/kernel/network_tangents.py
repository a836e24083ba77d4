"""Derivatives of the network and of its gradients along a direction of the point.

Forward over reverse: a dot marks the derivative along the direction; δ and h are those of
:mod:`dopt.kernel.network`.
"""

from __future__ import annotations

import math

from dopt.algorithm import FeatureKind
from dopt.kernel.compiler import compiled, contracted, squared
from dopt.kernel.network import layer, transposed_product
from dopt.kernel.output_layer import output_inputs_along, output_slope
from dopt.kernel.structs import Network
from dopt.types import Matrix, Vector


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
def tangents_at(
    network: Network,
    theta: Vector,
    phi: Vector,
    phi_dot: Vector,
    hidden: Matrix,
    component: int,
    deltas: Matrix,
    hidden_dot: Matrix,
    deltas_dot: Matrix,
) -> None:
    """Write the derivatives of the activations and of δ, (L, w) each, along a direction."""
    depth, width, m = network.offsets.shape[0] - 1, hidden.shape[1], network.n_factors
    below = phi_dot
    for index in range(depth):
        W, _ = layer(network, theta, index)
        for i in range(width):
            total = 0.0
            for j in range(W.shape[1]):
                total += W[i, j] * below[j]
            hidden_dot[index, i] = (1.0 - squared(hidden[index, i])) * total
        below = hidden_dot[index]
    W, _ = layer(network, theta, depth)
    for i in range(width):
        h = hidden[depth - 1, i]
        bend = -2.0 * h * hidden_dot[depth - 1, i]
        deltas_dot[depth - 1, i] = output_slope(network, W, phi, component, i) * bend
        for j in range(m):
            slope = phi_dot[phi_dot.shape[0] - m + j] * W[component, (1 + j) * width + i]
            deltas_dot[depth - 1, i] += slope * (1.0 - h * h)
    for index in range(depth - 1, 0, -1):
        W, _ = layer(network, theta, index)
        transposed_product(W, deltas_dot[index], deltas_dot[index - 1])
        for j in range(width):
            back = 0.0
            for i in range(width):
                back += W[i, j] * deltas[index, i]
            h = hidden[index - 1, j]
            bend = -2.0 * h * hidden_dot[index - 1, j]
            deltas_dot[index - 1, j] = deltas_dot[index - 1, j] * (1.0 - h * h) + back * bend


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
