"""Models in compiled code: points, accelerations, rows of J, and the change of these rows.

A point is what learned accelerations and their model depend on: a state, (d,), or a state and an
input, (d + m,).

Where a model is linear in its parameters the rows of J are the regressors Ψ(x). For the linear form
of physics their change along a direction is taken by a complex step through the system's own
equations.

Random features: combinations W ψ(x) of D given functions of the state. Random Fourier features are
ψ(x) = c cos(Ω φ(x) + b), with φ the features of the state; a linear map of the features has ψ = φ.
The learned parameters are the entries of W, row by row: row k of J has ψ at the places k D to
(k + 1) D and zeros elsewhere.

Grey box (:mod:`dopt.models.linear`): its features are the point itself, so that learners keep
points of samples.

======  ==================================================================  =====
symbol  meaning                                                             shape
======  ==================================================================  =====
p       all constants of the equations, θ in the places of the unknown
J       ∂a/∂θ at a point: the derivatives by the unknown constants          r × q
======  ==================================================================  =====
"""

from __future__ import annotations

import math

import numpy as np

from dopt.algorithm import Integrator, ModelKind
from dopt.kernel import gaussian_process
from dopt.kernel import network as nn
from dopt.kernel.compiler import compiled, copy_into, squared
from dopt.kernel.network import features_along, features_at
from dopt.kernel.structs import Linearization, Network, Plant
from dopt.types import Integers, Matrix, Stack, Vector


@compiled
def write_feature_rows(network: Network, x: Vector, rows: Matrix) -> None:
    """Write J, (r, r D), at a state."""
    phi, D = np.empty(network.sizes[0]), rows.shape[1] // rows.shape[0]
    features_at(network, x, phi)
    rows[:] = 0.0
    for i in range(D):
        if network.kind == ModelKind.LINEAR_STATE:
            value = phi[i]
        else:
            value = network.waves.scale * math.cos(_angle(network, phi, i))
        for k in range(rows.shape[0]):
            rows[k, k * D + i] = value


@compiled
def write_feature_row_along(
    network: Network, x: Vector, direction: Vector, component: int, out: Vector
) -> None:
    """Write the derivative of row ``component`` of J, (r D,), along a direction of the state."""
    phi, phi_dot = np.empty(network.sizes[0]), np.empty(network.sizes[0])
    features_at(network, x, phi)
    features_along(network, x, direction, phi_dot)
    out[:] = 0.0
    p, D = phi.shape[0], network.waves.phases.shape[0]
    if network.kind == ModelKind.LINEAR_STATE:
        copy_into(phi_dot, out[component * p : (component + 1) * p])
        return
    for i in range(D):
        slope = 0.0
        for j in range(phi_dot.shape[0]):
            slope += network.waves.frequencies[i, j] * phi_dot[j]
        out[component * D + i] = -network.waves.scale * math.sin(_angle(network, phi, i)) * slope


@compiled
def _angle(network: Network, phi: Vector, i: int) -> float:
    """Return entry i of Ω φ + b."""
    angle: float = network.waves.phases[i]
    for j in range(phi.shape[0]):
        angle += network.waves.frequencies[i, j] * phi[j]
    return angle


STEP = 1e-30
"""Imaginary part of a complex step: its square underflows beside any number."""

DIFFERENCE = 2e-5
"""Change of a point, relative to its size and 1, over which J is differentiated along it."""


@compiled
def constants_with(plant: Plant, network: Network, theta: Vector) -> Vector:
    """Return p: the plant's constants with θ in the places of the unknown."""
    constants = plant.parameters.copy()
    for j in range(theta.shape[0]):
        constants[network.unknown[j]] = theta[j]
    return constants


@compiled
def write_constant_rows(
    plant: Plant, x: Vector, constants: Vector, unknown: Integers, rows: Matrix
) -> None:
    """Write the derivatives of the accelerations at a point by some constants, (r, q).

    By a complex step through the equations themselves: exact to rounding.
    """
    z, value = x.astype(np.complex128), np.empty(rows.shape[0], np.complex128)
    stepped = constants.astype(np.complex128)
    for j in range(unknown.shape[0]):
        stepped[unknown[j]] += 1j * STEP
        plant.complex_accelerations(z, stepped, value)
        stepped[unknown[j]] = constants[unknown[j]]
        for k in range(rows.shape[0]):
            rows[k, j] = value[k].imag / STEP


@compiled
def write_rows_along(
    plant: Plant, network: Network, theta: Vector, x: Vector, direction: Vector, out: Matrix
) -> None:
    """Write the derivative of J, (r, q), along a direction of the point, by central differences.

    Their error is of fourth order in the step.
    """
    constants, rows = constants_with(plant, network, theta), np.empty(out.shape)
    out[:] = 0.0
    share = np.inf
    for i in range(direction.shape[0]):
        if direction[i] != 0.0:
            share = min(share, max(1.0, abs(x[i])) / abs(direction[i]))
    if not np.isfinite(share):
        return
    step = DIFFERENCE * share
    for moved, weight in ((2.0, -1.0), (1.0, 8.0), (-1.0, -8.0), (-2.0, 1.0)):
        at = x + moved * step * direction
        write_constant_rows(plant, at, constants, network.unknown, rows)
        out += weight / (12.0 * step) * rows


@compiled
def write_values(
    plant: Plant, network: Network, theta: Vector, points: Matrix, outputs: Matrix
) -> None:
    """Write a_θ, (r, N), at points one to a column, (d or d + m, N)."""
    constants, value = constants_with(plant, network, theta), np.empty(outputs.shape[0])
    for n in range(outputs.shape[1]):
        plant.accelerations(points[:, n].copy(), constants, value)
        outputs[:, n] = value


@compiled
def squared_error(
    plant: Plant, network: Network, theta: Vector, points: Matrix, targets: Matrix
) -> float:
    """Return Σ ‖y - a_θ‖² over points, (·, N), with observed accelerations y, (r, N)."""
    outputs, total = np.empty(targets.shape), 0.0
    write_values(plant, network, theta, points, outputs)
    for k in range(targets.shape[0]):
        for n in range(targets.shape[1]):
            total += squared(targets[k, n] - outputs[k, n])
    return total


@compiled
def write_normal_equations(
    plant: Plant,
    network: Network,
    theta: Vector,
    points: Matrix,
    targets: Matrix,
    normal: Matrix,
    slope: Vector,
) -> None:
    """Write ΣJᵀJ, (q, q), and ΣJᵀ(y - a_θ), (q,), over points, (·, N), with y, (r, N)."""
    constants, outputs = constants_with(plant, network, theta), np.empty(targets.shape)
    rows = np.empty((targets.shape[0], theta.shape[0]))
    write_values(plant, network, theta, points, outputs)
    normal[:] = 0.0
    slope[:] = 0.0
    for n in range(targets.shape[1]):
        write_constant_rows(plant, points[:, n].copy(), constants, network.unknown, rows)
        for k in range(rows.shape[0]):
            error = targets[k, n] - outputs[k, n]
            for i in range(rows.shape[1]):
                slope[i] += rows[k, i] * error
                for j in range(rows.shape[1]):
                    normal[i, j] += rows[k, i] * rows[k, j]


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
    """Return the number of points for a state whose input is not chosen yet: 1 or 2 m."""
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
        write_feature_rows(network, x, rows)
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
        constants = constants_with(plant, network, theta)
        plant.accelerations(x, constants, value)
        write_constant_rows(plant, x, constants, network.unknown, rows)
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
        write_rows_along(plant, network, theta, x, direction, rows)
        copy_into(rows[component], out)
        return
    if network.kind in (ModelKind.RANDOM_FEATURES, ModelKind.LINEAR_STATE):
        write_feature_row_along(network, x, direction, component, out)
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
        plant.accelerations(x, constants_with(plant, network, theta), out)
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
def accelerations_at(
    plant: Plant, network: Network, theta: Vector, states: Matrix, outputs: Matrix
) -> None:
    """Write a_θ, (r, N), at points, (N, ·)."""
    N, value = states.shape[0], np.empty(outputs.shape[0])
    if network.kind != ModelKind.MLP:
        for n in range(N):
            model_accelerations(plant, network, theta, states[n], value)
            outputs[:, n] = value
        return
    features = np.empty((network.feature_kinds.shape[0], N))
    hidden = np.empty((network.offsets.shape[0] - 1, network.sizes[1] * N))
    nn.write_features(network, states, features)
    nn.forward(network, theta, features, hidden, outputs)


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
    nn.output_signal(network, theta, point.phi, point.hidden, component, signals[0, depth - 1])
    for j in range(m):
        phi_dot, hidden_dot = point.phi_dots[j], point.hidden_dots[j]
        nn.features_along(network, x, directions[j], phi_dot)
        nn.activations_along(network, theta, phi_dot, point.hidden, hidden_dot)
        states = point.phi, phi_dot, point.hidden, hidden_dot
        nn.output_signal_along(network, theta, *states, component, signals[1 + j, depth - 1])
    nn.signals_below(network, theta, point.hidden, point.hidden_dots, signals)
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
    nn.back_signals(network, theta, phi, hidden, deltas)
    return phi, hidden, deltas


@compiled
def write_jacobian(network: Network, theta: Vector, x: Vector, rows: Matrix, value: Vector) -> None:
    """Write the learned rows of J, (r, at least q), and a_θ(x), (r,), at a point."""
    phi, hidden, deltas = all_components(network, theta, x, value)
    for k in range(rows.shape[0]):
        nn.parameter_gradient(network, phi, hidden, deltas[k], k, rows[k])


@compiled
def model_rows(plant: Plant, network: Network, theta: Vector, x: Vector, value: Vector) -> Matrix:
    """Return J, (r, q), at a point, and write a_θ, (r,), there."""
    rows = np.empty((value.shape[0], theta.shape[0]))
    if network.kind == ModelKind.MLP:
        write_jacobian(network, theta, x, rows, value)
    else:
        parameter_rows(plant, network, theta, x, rows, value)
    return rows


@compiled
def rows_at(plant: Plant, network: Network, theta: Vector, states: Matrix) -> Matrix:
    """Return the rows of J at points, (n, ·), as a matrix, (n r, q)."""
    n, r = states.shape[0], plant.learned_rows.shape[0]
    rows, value = np.empty((n * r, theta.shape[0])), np.empty(r)
    for i in range(n):
        rows[r * i : r * (i + 1)] = model_rows(plant, network, theta, states[i], value)
    return rows


@compiled
def write_network_gradients(
    network: Network, theta: Vector, bar: Vector, columns: Matrix, component: int, out: Matrix
) -> None:
    """Write g at a point and D B along the columns of B, (m, d), as rows, (1 + m, at least q)."""
    value = np.empty(network.sizes[network.sizes.shape[0] - 1])
    at = linearization_at(network, theta, bar, columns, component, value)
    nn.parameter_gradient(network, at.phi, at.hidden, at.deltas, component, out[0])
    for j in range(columns.shape[0]):
        nn.gradient_along(
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
def write_gradients(
    plant: Plant,
    network: Network,
    theta: Vector,
    x: Vector,
    directions: Matrix,
    component: int,
    out: Matrix,
) -> None:
    """As :func:`write_network_gradients`, for a model of any kind."""
    if network.kind == ModelKind.MLP:
        write_network_gradients(network, theta, x, directions, component, out)
        return
    r, q = plant.learned_rows.shape[0], theta.shape[0]
    rows = np.empty((r, q))
    parameter_rows(plant, network, theta, x, rows, np.empty(r))
    copy_into(rows[component], out[0])
    for j in range(directions.shape[0]):
        row_along(plant, network, theta, x, directions[j], component, out[1 + j, :q])
