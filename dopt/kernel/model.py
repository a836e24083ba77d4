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
    z = x + direction * (1j * STEP)
    offset = np.empty(world.learned_rows.shape[0], np.complex128)
    value = np.empty_like(offset)
    complex_accelerations(z, world.linear_form[0].astype(np.complex128), offset)
    for j in range(out.shape[0]):
        complex_accelerations(z, world.linear_form[1 + j].astype(np.complex128), value)
        out[j] = (value[component] - offset[component]).imag / STEP


@compiled
def model_accelerations(
    accelerations: Any, world: World, network: Network, theta: Any, x: Any
) -> Any:
    """Return a_θ(x), (r,)."""
    out = np.empty(world.learned_rows.shape[0])
    if network.kind == LINEAR_MODEL:
        rows = np.empty((out.shape[0], theta.shape[0]))
        regressors(accelerations, world, x, rows, out)
        out += np.dot(rows, theta)
        return out
    phi, hidden = _point_buffers(network)
    nn.features_at(network, x, phi)
    nn.activations_at(network, theta, phi, hidden, out)
    return out


@compiled
def jacobian_rows(
    accelerations: Any, world: World, network: Network, theta: Any, x: Any, rows: Any
) -> Any:
    """Write the learned rows of J(x), (r, q), and return a_θ(x), (r,)."""
    out = np.empty(world.learned_rows.shape[0])
    if network.kind == LINEAR_MODEL:
        regressors(accelerations, world, x, rows, out)
        out += np.dot(rows, theta)
        return out
    phi, hidden = _point_buffers(network)
    nn.features_at(network, x, phi)
    nn.activations_at(network, theta, phi, hidden, out)
    for k in range(out.shape[0]):
        nn.parameter_gradient(network, theta, phi, hidden, k, rows[k])
    return out


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
    if network.kind == LINEAR_MODEL:
        rows = np.empty((world.learned_rows.shape[0], theta.shape[0]))
        regressors(accelerations, world, x, rows, np.empty(rows.shape[0]))
        out[0] = rows[component]
        for j in range(directions.shape[0]):
            regressors_along(
                complex_accelerations, world, x, directions[j], component, out[1 + j]
            )
        return
    phi, hidden = _point_buffers(network)
    phi_dot, hidden_dot = _point_buffers(network)
    nn.features_at(network, x, phi)
    output = np.empty(world.learned_rows.shape[0])
    nn.activations_at(network, theta, phi, hidden, output)
    nn.parameter_gradient(network, theta, phi, hidden, component, out[0])
    for j in range(directions.shape[0]):
        nn.features_along(network, x, directions[j], phi_dot)
        nn.tangents_at(network, theta, phi_dot, hidden, hidden_dot)
        nn.gradient_along(
            network, theta, phi, phi_dot, hidden, hidden_dot, component, out[1 + j]
        )


@compiled
def _point_buffers(network: Network) -> Any:
    """Return room for the features, (p,), and the activations, (L, w), of one point."""
    depth = network.offsets.shape[0] - 1
    return np.empty(network.sizes[0]), np.empty((depth, network.sizes[1]))
