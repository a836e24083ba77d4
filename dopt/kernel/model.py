"""Models in compiled code: points, accelerations, rows of J, and the change of these rows.

A point is what learned accelerations and their model depend on: a state, (d,), or a state and an
input, (d + m,).

Where a model is linear in its parameters the rows of J are the regressors Ψ(x). For the linear form
of physics their change along a direction is taken by a complex step through the system's own
equations, for random features and grey boxes by :mod:`dopt.kernel.model_kinds`.
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import Integrator, ModelKind
from dopt.kernel import gaussian_process, model_kinds
from dopt.kernel import network as nn
from dopt.kernel import network_gradients as backward
from dopt.kernel import network_gradients as tangents
from dopt.kernel.compiler import compiled, copy_into
from dopt.kernel.structs import Linearization, Network, Plant
from dopt.types import Matrix, Stack, Vector


@compiled
def within(x: Vector, limit: float) -> bool:
    """Return True if every entry is finite and within the limit."""
    inside = True
    for i in range(x.shape[0]):
        inside = inside and abs(x[i]) <= limit
    return inside


@compiled
def plant_point(plant: Plant, x: Vector, u: Vector) -> Vector:
    """Return what the true accelerations depend on at a state and an input."""
    return joined(x, u, plant.n_inputs_read)


@compiled
def model_point(network: Network, x: Vector, u: Vector) -> Vector:
    """Return what the model depends on at a state and an input."""
    return joined(x, u, network.n_inputs_read)


@compiled
def sampled_state(plant: Plant, states: Matrix, t: int) -> Vector:
    """Return where the accelerations of step t are observed, given the states x_0 ... x_T."""
    return state_between(plant, states[t], states[t + 1])


@compiled
def state_between(plant: Plant, x: Vector, following: Vector) -> Vector:
    """Return where the accelerations of a step are observed: at its start, or in its middle.

    See :meth:`dopt.systems.base.System.sampled_states`.
    """
    if plant.integrator == Integrator.EULER:
        return x
    middle: Vector = 0.5 * (x + following)
    return middle


@compiled
def joined(x: Vector, u: Vector, n_inputs_read: int) -> Vector:
    """Return a state, or a copy with the input behind it."""
    if n_inputs_read == 0:
        return x
    d = x.shape[0]
    point = np.empty(d + n_inputs_read)
    copy_into(x, point[:d])
    copy_into(u, point[d:])
    return point


@compiled
def n_next_points(network: Network) -> int:
    """Return how many points stand for a state whose input is not chosen yet: 1 or 2 m."""
    return max(1, 2 * network.n_inputs_read)


@compiled
def next_points(network: Network, x: Vector, gamma: float) -> Matrix:
    """Return points that stand for a state whose input is not chosen yet.

    These are the state itself, (1, d), or for a model that reads inputs the state under ±γ along
    each axis, (2 m, d + m). The mean of JᵀJ over them is that over the sphere ‖u‖ = γ where J is
    affine in u.
    """
    d, m = x.shape[0], network.n_inputs_read
    points = np.zeros((n_next_points(network), d + m))
    points[:, :d] = x
    for j in range(m):
        points[2 * j, d + j] = gamma
        points[2 * j + 1, d + j] = -gamma
    return points


STEP = 1e-30


@compiled
def regressors(plant: Plant, network: Network, x: Vector, rows: Matrix, offset: Vector) -> None:
    """Write Ψ(x), (r, q), and the offset, (r,), of a model that is linear in its parameters.

    Both are NaN for a Gaussian process, which has no such rows.
    """
    if network.kind == ModelKind.GAUSSIAN_PROCESS:
        rows[:] = np.nan
        offset[:] = np.nan
        return
    if network.kind in (ModelKind.RANDOM_FEATURES, ModelKind.LINEAR_STATE):
        model_kinds.write_feature_rows(network, x, rows)
        offset[:] = 0.0
        return
    plant.accelerations(x, plant.linear_form[0], offset)
    value = np.empty_like(offset)
    for j in range(rows.shape[1]):
        plant.accelerations(x, plant.linear_form[1 + j], value)
        for k in range(value.shape[0]):
            rows[k, j] = value[k] - offset[k]


@compiled
def parameter_rows(
    plant: Plant, network: Network, theta: Vector, x: Vector, rows: Matrix, value: Vector
) -> None:
    """Write J, (r, q), and a_θ, (r,), at a point, for any model but a network."""
    if network.kind == ModelKind.GREY_BOX:
        constants = model_kinds.constants_with(plant, network, theta)
        plant.accelerations(x, constants, value)
        model_kinds.write_constant_rows(plant, x, constants, network.unknown, rows)
        return
    regressors(plant, network, x, rows, value)
    add_linear(rows, theta, value)


@compiled
def row_along(
    plant: Plant,
    network: Network,
    theta: Vector,
    x: Vector,
    direction: Vector,
    component: int,
    out: Vector,
) -> None:
    """Write the derivative of row ``component`` of J, (q,), along a direction of the state."""
    if network.kind == ModelKind.GREY_BOX:
        rows = np.empty((plant.learned_rows.shape[0], out.shape[0]))
        model_kinds.write_rows_along(plant, network, theta, x, direction, rows)
        copy_into(rows[component], out)
        return
    if network.kind in (ModelKind.RANDOM_FEATURES, ModelKind.LINEAR_STATE):
        model_kinds.write_feature_row_along(network, x, direction, component, out)
        return
    z = np.empty(x.shape[0], np.complex128)
    for i in range(x.shape[0]):
        z[i] = complex(x[i], STEP * direction[i])
    parameters = np.empty(plant.linear_form.shape[1], np.complex128)
    value = np.empty(plant.learned_rows.shape[0], np.complex128)
    offset = 0.0
    for j in range(1 + out.shape[0]):
        for i in range(parameters.shape[0]):
            parameters[i] = complex(plant.linear_form[j, i], 0.0)
        plant.complex_accelerations(z, parameters, value)
        slope = value[component].imag / STEP
        if j == 0:
            offset = slope
        else:
            out[j - 1] = slope - offset


@compiled
def add_linear(rows: Matrix, theta: Vector, out: Vector) -> None:
    """Add Ψ θ to the offset."""
    for k in range(out.shape[0]):
        for j in range(theta.shape[0]):
            out[k] += rows[k, j] * theta[j]


@compiled
def model_accelerations(
    plant: Plant, network: Network, theta: Vector, x: Vector, out: Vector
) -> None:
    """Write a_θ, (r,), at a point x."""
    if network.kind == ModelKind.GAUSSIAN_PROCESS:
        gaussian_process.write_mean(network, theta, x, out)
        return
    if network.kind == ModelKind.GREY_BOX:
        plant.accelerations(x, model_kinds.constants_with(plant, network, theta), out)
        return
    if network.kind != ModelKind.MLP:
        rows = np.empty((out.shape[0], theta.shape[0]))
        regressors(plant, network, x, rows, out)
        add_linear(rows, theta, out)
        return
    phi = np.empty(network.feature_kinds.shape[0])
    hidden = np.empty((network.offsets.shape[0] - 1, network.sizes[1]))
    nn.features_at(network, x, phi)
    nn.activations_at(network, theta, phi, hidden, out)


@compiled
def write_point_features(
    network: Network, states: Matrix, inputs: Matrix, features: Matrix
) -> None:
    """Write the features of states, (N, d), with inputs, (N, m), one point to a column, (p, N)."""
    d = states.shape[1]
    for j in range(features.shape[0]):
        index = network.feature_indices[j]
        values = states[:, index] if index < d else inputs[:, index - d]
        nn.write_feature(network, j, values, features[j])


@compiled
def write_features(network: Network, points: Matrix, features: Matrix) -> None:
    """Write the features of points, (N, ·), one point to a column, (p, N)."""
    for j in range(features.shape[0]):
        nn.write_feature(network, j, points[:, network.feature_indices[j]], features[j])


@compiled
def accelerations_at(
    plant: Plant, network: Network, theta: Vector, states: Matrix, outputs: Matrix
) -> None:
    """Write a_θ, (r, N), at points, (N, ·)."""
    N, r = states.shape[0], outputs.shape[0]
    if network.kind == ModelKind.GREY_BOX:
        model_kinds.write_values(plant, network, theta, states.T, outputs)
        return
    if network.kind == ModelKind.GAUSSIAN_PROCESS:
        gaussian_process.write_means(network, theta, states, outputs)
        return
    if network.kind != ModelKind.MLP:
        rows, value = np.empty((r, theta.shape[0])), np.empty(r)
        for n in range(N):
            regressors(plant, network, states[n], rows, value)
            add_linear(rows, theta, value)
            outputs[:, n] = value
        return
    features = np.empty((network.feature_kinds.shape[0], N))
    hidden = np.empty((network.offsets.shape[0] - 1, network.sizes[1] * N))
    write_features(network, states, features)
    nn.forward(network, theta, features, hidden, outputs)


@compiled
def euler_step(
    plant: Plant, x: Vector, u: Vector, accelerations: Vector, flow: Vector, following: Vector
) -> None:
    """Write x + dt f(x, u), (d,), given the accelerations, (r,)."""
    plant.known(x, u, plant.parameters, flow)
    for k in range(accelerations.shape[0]):
        flow[plant.learned_rows[k]] += accelerations[k]
    for j in range(x.shape[0]):
        following[j] = x[j] + plant.dt * flow[j]


@compiled
def linearization_at(
    network: Network, theta: Vector, x: Vector, directions: Matrix, component: int, out: Vector
) -> Linearization:
    """Run the network forward and back at a state and along directions, (m, d).

    ``out`` (r,) receives a_θ(x).
    """
    m, p = directions.shape[0], network.feature_kinds.shape[0]
    depth, width = network.offsets.shape[0] - 1, network.sizes[1]
    signals = np.empty((1 + m, depth, width))
    point = Linearization(
        np.empty(p),
        np.empty((depth, width)),
        signals[0],
        np.empty((m, p)),
        np.empty((m, depth, width)),
        signals[1:],
    )
    nn.features_at(network, x, point.phi)
    nn.activations_at(network, theta, point.phi, point.hidden, out)
    backward.output_signal(
        network, theta, point.phi, point.hidden, component, signals[0, depth - 1]
    )
    for j in range(m):
        phi_dot, hidden_dot = point.phi_dots[j], point.hidden_dots[j]
        tangents.features_along(network, x, directions[j], phi_dot)
        tangents.activations_along(network, theta, phi_dot, point.hidden, hidden_dot)
        tangents.output_signal_along(
            network,
            theta,
            point.phi,
            phi_dot,
            point.hidden,
            hidden_dot,
            component,
            signals[1 + j, depth - 1],
        )
    tangents.signals_below(network, theta, point.hidden, point.hidden_dots, signals)
    return point


@compiled
def all_components(
    network: Network, theta: Vector, x: Vector, out: Vector
) -> tuple[Vector, Matrix, Stack]:
    """Return features, activations and δ of every component, (r, L, w), at a state.

    ``out`` (r,) receives a_θ(x).
    """
    depth, width = network.offsets.shape[0] - 1, network.sizes[1]
    phi, hidden = np.empty(network.feature_kinds.shape[0]), np.empty((depth, width))
    deltas = np.empty((out.shape[0], depth, width))
    nn.features_at(network, x, phi)
    nn.activations_at(network, theta, phi, hidden, out)
    backward.back_signals(network, theta, phi, hidden, deltas)
    return phi, hidden, deltas


@compiled
def write_jacobian(network: Network, theta: Vector, x: Vector, rows: Matrix, value: Vector) -> None:
    """Write the learned rows of J, (r, at least q), and a_θ(x), (r,), at a point."""
    phi, hidden, deltas = all_components(network, theta, x, value)
    for k in range(rows.shape[0]):
        backward.parameter_gradient(network, phi, hidden, deltas[k], k, rows[k])


@compiled
def rows_at(plant: Plant, network: Network, theta: Vector, states: Matrix) -> Matrix:
    """Return the rows of J at points, (n, ·), as a matrix, (n r, q)."""
    n, r = states.shape[0], plant.learned_rows.shape[0]
    rows, value = np.empty((n * r, theta.shape[0])), np.empty(r)
    for i in range(n):
        if network.kind != ModelKind.MLP:
            parameter_rows(plant, network, theta, states[i], rows[r * i : r * (i + 1)], value)
        else:
            write_jacobian(network, theta, states[i], rows[r * i : r * (i + 1)], value)
    return rows


@compiled
def write_network_gradients(
    network: Network, theta: Vector, bar: Vector, columns: Matrix, component: int, out: Matrix
) -> None:
    """Write g at a point and D B along the columns of B, (m, d), as rows, (1 + m, at least q)."""
    value = np.empty(network.sizes[network.sizes.shape[0] - 1])
    at = linearization_at(network, theta, bar, columns, component, value)
    backward.parameter_gradient(network, at.phi, at.hidden, at.deltas, component, out[0])
    for j in range(columns.shape[0]):
        tangents.gradient_along(
            network,
            at.phi,
            at.phi_dots[j],
            at.hidden,
            at.hidden_dots[j],
            at.deltas,
            at.deltas_dots[j],
            component,
            out[1 + j],
        )


@compiled
def write_model_gradients(
    plant: Plant,
    network: Network,
    theta: Vector,
    x: Vector,
    directions: Matrix,
    component: int,
    out: Matrix,
) -> None:
    """Do what :func:`write_network_gradients` does for any model but a network."""
    r, q = plant.learned_rows.shape[0], theta.shape[0]
    rows = np.empty((r, q))
    parameter_rows(plant, network, theta, x, rows, np.empty(r))
    copy_into(rows[component], out[0])
    for j in range(directions.shape[0]):
        row_along(plant, network, theta, x, directions[j], component, out[1 + j, :q])
