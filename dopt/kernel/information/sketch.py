"""Projection of parameter gradients to a few dimensions (count sketch) in compiled code.

Every parameter adds to one of s entries with a random sign, so that inner products are kept on
average; M⁻¹ is then s × s whatever the width and the horizon. Reference: M. Charikar, K. Chen and
M. Farach-Colton, "Finding frequent items in data streams" (2002).
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled, contracted
from dopt.kernel.information.dual import below, below_along
from dopt.kernel.information.primal import quadratic_forms, rank_update
from dopt.kernel.model import all_components, linearization_at
from dopt.kernel.output_layer import output_inputs_along, output_inputs_at
from dopt.kernel.state_structs import Linearization, Sketch, State
from dopt.kernel.structs import Network, Plant
from dopt.types import Matrix, Vector


@compiled
def add_rows(plant: Plant, network: Network, state: State, x: Vector) -> None:
    """Add JᵀJ at a state (:data:`dopt.kernel.structs.AddRows`)."""
    value = np.zeros(plant.learned_rows.shape[0])
    phi, hidden, deltas = all_components(network, state.theta, x, value)
    rows = np.zeros((deltas.shape[0], state.sketch.size))
    for k in range(rows.shape[0]):
        _add_gradient(state.sketch, network, phi, hidden, deltas[k], k, rows[k])
    rank_update(state.covariance, rows, value, np.empty(rows.shape))  # no residuals: θ stays


@compiled
def planning_forms(
    plant: Plant, network: Network, state: State, bar: Vector, columns: Matrix, component: int
) -> Matrix:
    """Return xᵀM⁻¹y at a state (:data:`dopt.kernel.structs.PlanningForms`)."""
    m, value = columns.shape[0], np.empty(plant.learned_rows.shape[0])
    at = linearization_at(network, state.theta, bar, columns, component, value)
    G = np.zeros((1 + m, state.sketch.size))
    _add_gradient(state.sketch, network, at.phi, at.hidden, at.deltas, component, G[0])
    for j in range(m):
        _add_gradient_along(state.sketch, network, at, j, component, G[1 + j])
    return quadratic_forms(state.covariance, G[: 1 if m == 1 else 1 + m], G)


@compiled
def _add_gradient(
    sketch: Sketch,
    network: Network,
    phi: Vector,
    hidden: Matrix,
    deltas: Matrix,
    component: int,
    out: Vector,
) -> None:
    """Add the sketch, (s,), of a gradient: in each layer δ ⊗ (activations below, 1)."""
    depth = hidden.shape[0]
    for index in range(depth):
        _add_layer(sketch, network, index, deltas[index], below(phi, hidden, index), out)
    top = output_inputs_at(network, hidden[depth - 1], phi)
    _add_output_layer(sketch, network, component, top, 1.0, out)


@compiled
def _add_gradient_along(
    sketch: Sketch, network: Network, at: Linearization, j: int, component: int, out: Vector
) -> None:
    """Add the sketch, (s,), of the derivative of a gradient along direction j."""
    depth = at.hidden.shape[0]
    for index in range(depth):
        delta, delta_dot = at.deltas[index], at.deltas_dots[j, index]
        h, h_dot = below(at.phi, at.hidden, index), below_along(at, j, index)
        _add_layer_along(sketch, network, index, delta, delta_dot, h, h_dot, out)
    last, last_dot = at.hidden[depth - 1], at.hidden_dots[j, depth - 1]
    top_dot = output_inputs_along(network, last, last_dot, at.phi, at.phi_dots[j])
    _add_output_layer(sketch, network, component, top_dot, 0.0, out)


@contracted
def _add_layer(
    sketch: Sketch, network: Network, index: int, delta: Vector, h: Vector, out: Vector
) -> None:
    """Add δ ⊗ (h, 1)."""
    n, start = network.layer_inputs[index], network.offsets[index]
    for i in range(delta.shape[0]):
        buckets, signs = sketch.buckets[start : start + n], sketch.signs[start : start + n]
        start += n
        for j in range(n):
            out[buckets[j]] += signs[j] * (delta[i] * h[j])
    _add(sketch, start, delta, out)


@contracted
def _add_layer_along(
    sketch: Sketch,
    network: Network,
    index: int,
    delta: Vector,
    delta_dot: Vector,
    h: Vector,
    h_dot: Vector,
    out: Vector,
) -> None:
    """Add the derivative of δ ⊗ (h, 1) by the product rule."""
    n, start = network.layer_inputs[index], network.offsets[index]
    for i in range(delta.shape[0]):
        buckets, signs = sketch.buckets[start : start + n], sketch.signs[start : start + n]
        start += n
        for j in range(n):
            value = delta_dot[i] * h[j] + delta[i] * h_dot[j]
            out[buckets[j]] += signs[j] * value
    _add(sketch, start, delta_dot, out)


@compiled
def _add_output_layer(
    sketch: Sketch, network: Network, component: int, top: Vector, one: float, out: Vector
) -> None:
    """Add the row of output k, (top, one); the rows of the others are zero."""
    depth = network.offsets.shape[0] - 1
    start, n = network.offsets[depth], top.shape[0]
    _add(sketch, start + component * n, top, out)
    bias = start + network.sizes[depth + 1] * n + component
    out[sketch.buckets[bias]] += sketch.signs[bias] * one


@compiled
def _add(sketch: Sketch, start: int, values: Vector, out: Vector) -> None:
    """Add the sketch of the entries of a gradient from one on."""
    for i in range(values.shape[0]):
        out[sketch.buckets[start + i]] += sketch.signs[start + i] * values[i]
