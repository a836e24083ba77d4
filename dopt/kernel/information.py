"""Forms in which a trial holds the information matrix M, in compiled code.

A form is a pair of functions (:class:`dopt.kernel.structs.Information`): one adds JᵀJ at a state,
the other gives xᵀM⁻¹y for the planner. The first forms hold M⁻¹, (q, q).

The dual form needs no q × q matrix. With G the N × q matrix of all rows seen, M = λI + GᵀG and
K = λI + GGᵀ = CCᵀ (Cholesky),

    aᵀM⁻¹b = (aᵀb - (C⁻¹Ga)ᵀ(C⁻¹Gb)) / λ    (Woodbury).

For a network the inner products of parameter gradients need no parameter gradients: each is a sum
over layers of (δ · δ')(h · h' + 1), with h the activations below the layer and δ the derivative of
the output with respect to its pre-activations. A step costs O(n w) for the products and O(N²) for
the triangular solves, N = n r rows from n states; memory is O(n w + N²). The derivative of g along
a direction of the state replaces h by ḣ and δ by its derivative, one at a time (product rule).

The sketch projects parameter gradients to a few dimensions: every parameter adds to one of s
entries with a random sign, so that inner products are kept on average; M⁻¹ is then s × s whatever
the width and the horizon. Reference: M. Charikar, K. Chen and M. Farach-Colton, "Finding frequent
items in data streams" (2002).
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import ModelKind
from dopt.kernel.compiler import compiled, copy_into
from dopt.kernel.linear_algebra import (
    factorize,
    multiply_planned,
    replaced,
    settle,
    solve_lower,
    write_inverse,
)
from dopt.kernel.model import (
    all_components,
    linearization_at,
    parameter_rows,
    write_gradients,
    write_jacobian,
)
from dopt.kernel.network import features_at, multiply_vector, output_inputs_along, output_inputs_at
from dopt.kernel.normal_equations import write_normal
from dopt.kernel.structs import (
    Covariance,
    Dual,
    Information,
    Linearization,
    Network,
    Plant,
    Sketch,
    State,
)
from dopt.kernel.vectors import inner, inner_products
from dopt.types import Matrix, Stack, Vector


@compiled
def add_nothing(plant: Plant, network: Network, state: State, x: Vector) -> None:
    """Leave M as it is."""


@compiled
def undefined_forms(
    plant: Plant,  # noqa: ARG001
    network: Network,  # noqa: ARG001
    state: State,  # noqa: ARG001
    bar: Vector,  # noqa: ARG001
    columns: Matrix,
    component: int,  # noqa: ARG001
) -> Matrix:
    """Return NaN: an input that is planned with it ends the trial as diverged."""
    return np.full((1 + columns.shape[0], 1 + columns.shape[0]), np.nan)


@compiled
def deferred(covariance: Covariance, r: int) -> Matrix:
    """Return the place for r rows, (r, Q), that are added to M before it is read next."""
    settle(covariance)
    covariance.n_deferred[0] = r
    return covariance.rows[:r]


@compiled
def planned(covariance: Covariance, k: int) -> Matrix:
    """Return the place for k rows, (k, Q), whose products with M⁻¹ a plan needs."""
    first = covariance.n_deferred[0]
    return covariance.rows[first : first + k]


@compiled
def planned_forms(covariance: Covariance, G: Matrix) -> Matrix:
    """Return xᵀM⁻¹y for x and y among the planned rows, the first ones of x where m = 1."""
    products = multiply_planned(covariance, 1 if G.shape[0] == 2 else G.shape[0])
    forms = np.empty((products.shape[0], G.shape[0]))
    inner_products(products, G, forms)
    return forms


@compiled
def add_rows(plant: Plant, network: Network, state: State, x: Vector) -> None:
    """Add JᵀJ at a state (:data:`dopt.kernel.structs.AddRows`)."""
    r = plant.learned_rows.shape[0]
    if network.kind == ModelKind.MLP:
        write_jacobian(network, state.theta, x, deferred(state.covariance, r), np.empty(r))
        return
    rows = np.empty((r, state.theta.shape[0]))
    parameter_rows(plant, network, state.theta, x, rows, np.empty(r))
    places = deferred(state.covariance, r)
    for k in range(r):
        copy_into(rows[k], places[k])


@compiled
def forms(
    plant: Plant, network: Network, state: State, bar: Vector, columns: Matrix, component: int
) -> Matrix:
    """Return xᵀM⁻¹y at a state (:data:`dopt.kernel.structs.PlanningForms`)."""
    G = planned(state.covariance, 1 + columns.shape[0])
    write_gradients(plant, network, state.theta, bar, columns, component, G)
    return planned_forms(state.covariance, G)


@compiled
def add_fresh_rows(plant: Plant, network: Network, state: State, x: Vector) -> None:
    """Add JᵀJ at a state; in every k-th step sum M of all states (:data:`structs.AddRows`).

    θ is NaN afterwards, which ends the trial as diverged, where rounding has left M indefinite or
    its inverse is not finite.
    """
    visited, covariance = state.visited, state.covariance
    n, q = visited.n_states[0], state.theta.shape[0]
    phi = np.empty(network.feature_kinds.shape[0])
    features_at(network, x, phi)
    copy_into(phi, visited.features[:, n])
    visited.n_states[0] = n + 1
    if (n + 1) % visited.refresh_every != 0:
        add_rows(plant, network, state, x)
        return
    normal, slope, seen = np.empty((q, q)), np.empty(q), visited.features[:, : n + 1].copy()
    nothing = np.zeros((plant.learned_rows.shape[0], n + 1))
    write_normal(plant, network, state.theta, seen, nothing, normal, slope)
    for i in range(q):
        normal[i, i] += visited.regularization
    if not (factorize(normal) and write_inverse(normal, covariance.upper)):
        state.theta[:] = np.nan
    replaced(covariance)
    covariance.n_deferred[0] = 0


BLOCK_BYTES = 2**18
"""Bytes of a block of stored activations, which all products with it find in the cache."""


@compiled
def add_dual_rows(plant: Plant, network: Network, state: State, x: Vector) -> None:
    """Add JᵀJ at a state (:data:`dopt.kernel.structs.AddRows`)."""
    value = np.zeros(plant.learned_rows.shape[0])
    phi, hidden, deltas = all_components(network, state.theta, x, value)
    _rank_update(state.dual, phi, hidden, deltas)


@compiled
def dual_forms(
    plant: Plant, network: Network, state: State, bar: Vector, columns: Matrix, component: int
) -> Matrix:
    """Return xᵀM⁻¹y at a state (:data:`dopt.kernel.structs.PlanningForms`)."""
    value = np.empty(plant.learned_rows.shape[0])
    point = linearization_at(network, state.theta, bar, columns, component, value)
    return _forms(state.dual, point, component)


@compiled
def below(phi: Vector, hidden: Matrix, index: int) -> Vector:
    """Return the activations below a layer."""
    activations: Vector = phi if index == 0 else hidden[index - 1]
    return activations


@compiled
def below_along(point: Linearization, j: int, index: int) -> Vector:
    """Return the derivative of the activations below a layer along direction j."""
    along: Vector = point.phi_dots[j] if index == 0 else point.hidden_dots[j, index - 1]
    return along


@compiled
def stored_below(dual: Dual, start: int, stop: int, index: int) -> Matrix:
    """Return the activations below a layer at some of the states seen."""
    if index == 0:
        return dual.features[start:stop]
    return dual.hidden[index - 1, start:stop]


@compiled
def _forms(dual: Dual, point: Linearization, component: int) -> Matrix:
    """Return xᵀM⁻¹y, (1 + m, 1 + m), for x and y among g and the columns of D B."""
    n, r = dual.n_states[0], dual.deltas.shape[0]
    products = np.zeros((1 + point.phi_dots.shape[0], n * r))
    step = _block(dual)
    for start in range(0, n, step):
        values = _values(dual, start, min(start + step, n), point.phi, point.hidden)
        _add_products(dual, start, values, point, component, products)
    solve_lower(dual.factor, n * r, products)
    out = _own_products(point)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = (out[i, j] - inner(products[i], products[j])) / dual.regularization
    return out


@compiled
def _rank_update(dual: Dual, phi: Vector, hidden: Matrix, deltas: Stack) -> None:
    """Add the r rows of J at one state, given the passes there; ``deltas`` is (r, L, w)."""
    n, r = dual.n_states[0], deltas.shape[0]
    _store(dual, n, phi, hidden, deltas)
    N = n * r
    rows = np.zeros((r, N + r))
    no_phi, no_hidden = np.empty((0, 0)), np.empty((0, 0, 0))
    step = _block(dual)
    for start in range(0, n + 1, step):
        values = _values(dual, start, min(start + step, n + 1), phi, hidden)
        for k in range(r):
            point = Linearization(phi, hidden, deltas[k], no_phi, no_hidden, no_hidden)
            _add_products(dual, start, values, point, k, rows[k : k + 1])
    solve_lower(dual.factor, N, rows)
    for k in range(r):
        R = N + k
        for i in range(N, R):
            row = dual.factor[i]
            rows[k, i] = (rows[k, i] - inner(row[:i], rows[k, :i])) / row[i]
        for i in range(R):
            dual.factor[R, i] = rows[k, i]
        # A Schur complement of λI + GGᵀ: never below λ, except by rounding.
        rest = rows[k, R] - inner(rows[k, :R], rows[k, :R])
        dual.factor[R, R] = np.sqrt(dual.regularization + max(rest, 0.0))
    dual.n_states[0] = n + 1


@compiled
def _store(dual: Dual, n: int, phi: Vector, hidden: Matrix, deltas: Stack) -> None:
    """Keep the activations and δ of a state in place n."""
    for i in range(phi.shape[0]):
        dual.features[n, i] = phi[i]
    for index in range(hidden.shape[0]):
        for i in range(hidden.shape[1]):
            dual.hidden[index, n, i] = hidden[index, i]
            for k in range(deltas.shape[0]):
                dual.deltas[k, index, n, i] = deltas[k, index, i]


@compiled
def _block(dual: Dual) -> int:
    """Return the number of states in a block."""
    states: int = BLOCK_BYTES // (8 * dual.hidden.shape[2])
    return max(4, states // 4 * 4)


@compiled
def _values(dual: Dual, start: int, stop: int, phi: Vector, hidden: Matrix) -> Matrix:
    """Return h · h' of each layer, (L + 1, n), of a state with n of those seen."""
    out = np.empty((hidden.shape[0] + 1, stop - start))
    for index in range(out.shape[0]):
        stored = stored_below(dual, start, stop, index)
        multiply_vector(stored, below(phi, hidden, index), out[index])
    return out


@compiled
def _add_products(
    dual: Dual, start: int, values: Matrix, point: Linearization, component: int, out: Matrix
) -> None:
    """Add the products of g and of each column of D B with all rows of n of the states seen.

    ``values`` (L + 1, n) come from :func:`_values`; ``out`` (1 + m, ·) has a column for each row
    of J.
    """
    r, depth, m = dual.deltas.shape[0], dual.deltas.shape[1], point.phi_dots.shape[0]
    stop = start + values.shape[1]
    slopes = np.empty((m, stop - start))
    back, back_dot = np.empty(stop - start), np.empty(stop - start)
    for index in range(depth + 1):
        stored = stored_below(dual, start, stop, index)
        for j in range(m):
            multiply_vector(stored, below_along(point, j, index), slopes[j])
        if index == depth:
            first = start * r + component
            _add_spread(values[index], 1.0, first, r, out[0])
            for j in range(m):
                _add_spread(slopes[j], 0.0, first, r, out[1 + j])
            continue
        for k in range(r):
            first = start * r + k
            signals = dual.deltas[k, index, start:stop]
            multiply_vector(signals, point.deltas[index], back)
            _add_layer(back, values[index], 1.0, first, r, out[0])
            for j in range(m):
                _add_layer(back, slopes[j], 0.0, first, r, out[1 + j])
                multiply_vector(signals, point.deltas_dots[j, index], back_dot)
                _add_layer(back_dot, values[index], 1.0, first, r, out[1 + j])


@compiled
def _add_layer(a: Vector, b: Vector, one: float, first: int, stride: int, out: Vector) -> None:
    """Add a (b + one) to every ``stride``-th entry."""
    for s in range(a.shape[0]):
        out[first + s * stride] += a[s] * (b[s] + one)


@compiled
def _add_spread(values: Vector, one: float, first: int, stride: int, out: Vector) -> None:
    """Add values + one to every ``stride``-th entry."""
    for s in range(values.shape[0]):
        out[first + s * stride] += values[s] + one


@compiled
def _own_products(point: Linearization) -> Matrix:
    """Return the inner products among g and the columns of D B, (1 + m, 1 + m)."""
    depth, m = point.hidden.shape[0], point.phi_dots.shape[0]
    out = np.zeros((1 + m, 1 + m))
    for index in range(depth + 1):
        h = below(point.phi, point.hidden, index)
        last = index == depth
        # In the output layer δ is the unit vector of the component and does not change.
        delta = point.deltas[0 if last else index]
        size = 1.0 if last else inner(delta, delta)
        base = inner(h, h) + 1.0
        out[0, 0] += size * base
        for i in range(m):
            h_i = below_along(point, i, index)
            cross_i = 0.0 if last else inner(delta, point.deltas_dots[i, index])
            out[0, 1 + i] += cross_i * base + size * inner(h, h_i)
            for j in range(i + 1):
                h_j = below_along(point, j, index)
                cross_j, both = 0.0, 0.0
                if not last:
                    cross_j = inner(delta, point.deltas_dots[j, index])
                    both = inner(point.deltas_dots[i, index], point.deltas_dots[j, index])
                out[1 + i, 1 + j] += both * base + size * inner(h_i, h_j)
                out[1 + i, 1 + j] += cross_i * inner(h, h_j) + cross_j * inner(h, h_i)
    for i in range(1 + m):
        for j in range(i):
            if j == 0:
                out[i, 0] = out[0, i]
            else:
                out[j, i] = out[i, j]
    return out


@compiled
def add_sketched_rows(plant: Plant, network: Network, state: State, x: Vector) -> None:
    """Add JᵀJ at a state (:data:`dopt.kernel.structs.AddRows`)."""
    value = np.zeros(plant.learned_rows.shape[0])
    phi, hidden, deltas = all_components(network, state.theta, x, value)
    rows = deferred(state.covariance, deltas.shape[0])
    rows[:] = 0.0
    for k in range(rows.shape[0]):
        _add_gradient(state.sketch, network, phi, hidden, deltas[k], k, rows[k])


@compiled
def sketched_forms(
    plant: Plant, network: Network, state: State, bar: Vector, columns: Matrix, component: int
) -> Matrix:
    """Return xᵀM⁻¹y at a state (:data:`dopt.kernel.structs.PlanningForms`)."""
    m, value = columns.shape[0], np.empty(plant.learned_rows.shape[0])
    at = linearization_at(network, state.theta, bar, columns, component, value)
    G = planned(state.covariance, 1 + m)
    G[:] = 0.0
    _add_gradient(state.sketch, network, at.phi, at.hidden, at.deltas, component, G[0])
    for j in range(m):
        _add_gradient_along(state.sketch, network, at, j, component, G[1 + j])
    return planned_forms(state.covariance, G)


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
        _add_sketched_layer(sketch, network, index, deltas[index], below(phi, hidden, index), out)
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


@compiled
def _add_sketched_layer(
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


@compiled
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


ABSENT = Information(add_nothing, undefined_forms)
PRIMAL = Information(add_rows, forms)
FRESH = Information(add_fresh_rows, forms)
DUAL = Information(add_dual_rows, dual_forms)
SKETCH = Information(add_sketched_rows, sketched_forms)

FORMS = (ABSENT, PRIMAL, DUAL, SKETCH, FRESH)
"""All forms, in the order in which they are compiled."""
