"""Both models behind one set of functions: accelerations, rows of the Jacobian, their change.

For the linear model the rows of J are the regressors Ψ(x) and their change along a direction is
taken by a complex step through the system's own equations.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dopt.kernel import network as nn
from dopt.kernel.arguments import LINEAR_MODEL, Network, World
from dopt.kernel.compiler import compiled

STEP = 1e-30


@compiled
def regressors(accelerations: Any, world: World, x: Any, rows: Any, offset: Any) -> None:
    """Write Ψ(x), (r, q), and the offset, (r,), of the linear model."""
    accelerations(x, world.linear_form[0], offset)
    value = np.empty_like(offset)
    for j in range(rows.shape[1]):
        accelerations(x, world.linear_form[1 + j], value)
        for k in range(value.shape[0]):
            rows[k, j] = value[k] - offset[k]


@compiled
def regressors_along(
    complex_accelerations: Any, world: World, x: Any, direction: Any, component: int, out: Any
) -> None:
    """Write the derivative of row ``component`` of Ψ, (q,), along a direction of the state."""
    z = np.empty(x.shape[0], np.complex128)
    for i in range(x.shape[0]):
        z[i] = complex(x[i], STEP * direction[i])
    parameters = np.empty(world.linear_form.shape[1], np.complex128)
    value = np.empty(world.learned_rows.shape[0], np.complex128)
    offset = 0.0
    for j in range(1 + out.shape[0]):
        for i in range(parameters.shape[0]):
            parameters[i] = complex(world.linear_form[j, i], 0.0)
        complex_accelerations(z, parameters, value)
        slope = value[component].imag / STEP
        if j == 0:
            offset = slope
        else:
            out[j - 1] = slope - offset


@compiled
def add_linear(rows: Any, theta: Any, out: Any) -> None:
    """Add Ψ θ to the offset."""
    for k in range(out.shape[0]):
        for j in range(theta.shape[0]):
            out[k] += rows[k, j] * theta[j]


@compiled
def model_accelerations(
    accelerations: Any, world: World, network: Network, theta: Any, x: Any, out: Any
) -> None:
    """Write a_θ(x), (r,)."""
    if network.kind == LINEAR_MODEL:
        rows = np.empty((out.shape[0], theta.shape[0]))
        regressors(accelerations, world, x, rows, out)
        add_linear(rows, theta, out)
        return
    phi, hidden, _ = _point_buffers(network)
    nn.features_at(network, x, phi)
    nn.activations_at(network, theta, phi, hidden, out)


@compiled
def jacobian_rows(
    accelerations: Any, world: World, network: Network, theta: Any, x: Any, rows: Any, out: Any
) -> None:
    """Write the learned rows of J(x), (r, q), and a_θ(x), (r,)."""
    if network.kind == LINEAR_MODEL:
        regressors(accelerations, world, x, rows, out)
        add_linear(rows, theta, out)
        return
    phi, hidden, deltas = _point_buffers(network)
    nn.features_at(network, x, phi)
    nn.activations_at(network, theta, phi, hidden, out)
    for k in range(out.shape[0]):
        nn.back_signals(network, theta, hidden, k, deltas)
        nn.parameter_gradient(network, phi, hidden, deltas, k, rows[k])


@compiled
def gradient_and_changes(
    accelerations: Any,
    complex_accelerations: Any,
    world: World,
    network: Network,
    theta: Any,
    x: Any,
    directions: Any,
    component: int,
    out: Any,
) -> None:
    """Write g and D B for one component: ``out`` (1 + m, q), ``directions`` (m, d)."""
    output = np.empty(world.learned_rows.shape[0])
    if network.kind == LINEAR_MODEL:
        rows = np.empty((output.shape[0], theta.shape[0]))
        regressors(accelerations, world, x, rows, output)
        for i in range(theta.shape[0]):
            out[0, i] = rows[component, i]
        for j in range(directions.shape[0]):
            regressors_along(complex_accelerations, world, x, directions[j], component, out[1 + j])
        return
    phi, hidden, deltas = _point_buffers(network)
    phi_dot, hidden_dot, deltas_dot = _point_buffers(network)
    nn.features_at(network, x, phi)
    nn.activations_at(network, theta, phi, hidden, output)
    nn.back_signals(network, theta, hidden, component, deltas)
    nn.parameter_gradient(network, phi, hidden, deltas, component, out[0])
    for j in range(directions.shape[0]):
        nn.features_along(network, x, directions[j], phi_dot)
        nn.tangents_at(network, theta, phi_dot, hidden, component, deltas, hidden_dot, deltas_dot)
        nn.gradient_along(
            network, phi, phi_dot, hidden, hidden_dot, deltas, deltas_dot, component, out[1 + j]
        )


@compiled
def _point_buffers(network: Network) -> Any:
    """Return room for the features, (p,), the activations and the δ, (L, w), of one point."""
    depth, width = network.offsets.shape[0] - 1, network.sizes[1]
    return np.empty(network.sizes[0]), np.empty((depth, width)), np.empty((depth, width))
