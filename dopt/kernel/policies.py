"""Closed-loop policies in compiled code: D-optimal (Algorithm 2) and uniform exploration."""

from __future__ import annotations

from typing import Any

import numpy as np

from dopt.kernel.arguments import DUAL, LINEAR_MODEL, SKETCH, Network, Rules, State, World
from dopt.kernel.compiler import compilable, compiled
from dopt.kernel.dual import dual_forms
from dopt.kernel.information import quadratic_forms
from dopt.kernel.model import (
    euler_step,
    linear_gradients,
    model_accelerations,
    network_gradients,
    point_at,
)
from dopt.kernel.sketch import sketched
from dopt.planning.sphere import sphere_maximizer
from dopt.planning.ties import TIE_MARGIN

compilable(sphere_maximizer)


@compiled
def predicted_state(
    known: Any, accelerations: Any, world: World, network: Network, theta: Any, x: Any
) -> Any:
    """Return x̄ = x + dt f_θ(x, 0), (d,)."""
    flow, following = np.empty(x.shape[0]), np.empty(x.shape[0])
    a = np.empty(world.learned_rows.shape[0])
    model_accelerations(accelerations, world, network, theta, x, a)
    euler_step(known, world, x, np.zeros(world.n_inputs), a, flow, following)
    return following


@compiled
def input_columns(known: Any, world: World, x: Any) -> Any:
    """Return the rows of Bᵀ = dt (∂f/∂u)ᵀ, (m, d), at a state; the input term is linear."""
    base, u = np.empty(x.shape[0]), np.zeros(world.n_inputs)
    known(x, u, world.parameters, base)
    columns = np.empty((world.n_inputs, x.shape[0]))
    for j in range(world.n_inputs):
        u[j] = 1.0
        known(x, u, world.parameters, columns[j])
        u[j] = 0.0
        for i in range(x.shape[0]):
            columns[j, i] = world.dt * (columns[j, i] - base[i])
    return columns


@compiled
def planning_forms(
    accelerations: Any,
    complex_accelerations: Any,
    world: World,
    network: Network,
    rules: Rules,
    state: State,
    bar: Any,
    columns: Any,
    component: int,
) -> Any:
    """Return xᵀM⁻¹y for x and y among g and the columns of D B, (1 or 1 + m, 1 + m).

    With one input the quadratic term of equation 7 is constant on the sphere: the row of g is
    enough and costs one product with M⁻¹.
    """
    q, m = state.theta.shape[0], columns.shape[0]
    if network.kind == LINEAR_MODEL:
        G = linear_gradients(
            accelerations, complex_accelerations, world, q, bar, columns, component
        )
    else:
        a = np.empty(world.learned_rows.shape[0])
        point = point_at(network, state.theta, bar, columns, component, a)
        if rules.form == DUAL:
            return dual_forms(state.dual, rules.regularization, point, component)
        G = network_gradients(network, point, component, q)
        if rules.form == SKETCH:
            G = sketched(state.sketch, G)
    return quadratic_forms(state.covariance, G[: 1 if m == 1 else 1 + m], G)


@compiled
def d_optimal_input(
    known: Any,
    accelerations: Any,
    complex_accelerations: Any,
    world: World,
    network: Network,
    rules: Rules,
    state: State,
    x: Any,
    component: int,
    tie: Any,
    u: Any,
) -> None:
    """Write the maximiser of (g + D B u)ᵀ M⁻¹ (g + D B u), or its sum, on the sphere, (m,)."""
    bar = predicted_state(known, accelerations, world, network, state.theta, x)
    columns = input_columns(known, world, bar)
    m = columns.shape[0]
    S = np.zeros((1 if m == 1 else 1 + m, 1 + m))
    for k in range(world.learned_rows.shape[0]):
        if rules.all_components or k == component:
            forms = planning_forms(
                accelerations,
                complex_accelerations,
                world,
                network,
                rules,
                state,
                bar,
                columns,
                k,
            )
            for i in range(S.shape[0]):
                for j in range(S.shape[1]):
                    S[i, j] += forms[i, j]
    if m == 1:
        up = S[0, 1] > 0.0 or (S[0, 1] == 0.0 and tie[0] > 0.0)
        u[0] = world.gamma if up else -world.gamma
        return
    Q, v = np.empty((m, m)), np.empty(m)
    for i in range(m):
        v[i] = -S[0, 1 + i]
        for j in range(m):
            Q[i, j] = S[1 + i, 1 + j]
    chosen = sphere_maximizer(Q, v, world.gamma, tie)
    for i in range(m):
        u[i] = chosen[i]


@compiled
def uniform_input(
    known: Any,
    accelerations: Any,
    world: World,
    network: Network,
    state: State,
    states: Any,
    t: int,
    steps: int,
    best: Any,
) -> None:
    """Write the best end point of gradient ascents of Σ_{s≤t} ‖x(u) - x_s‖ on the sphere."""
    x = states[t]
    center = predicted_state(known, accelerations, world, network, state.theta, x)
    columns = input_columns(known, world, x)
    m = columns.shape[0]
    best_value = -1.0
    u, gradient = np.empty(m), np.empty(m)
    for start in range(2 * m):
        for j in range(m):
            u[j] = 0.0
        u[start // 2] = world.gamma if start % 2 == 0 else -world.gamma
        for _ in range(steps if m > 1 else 0):
            _distances(center, columns, u, states, t, gradient)
            norm = 0.0
            for j in range(m):
                norm += gradient[j] * gradient[j]
            if norm == 0.0:
                break
            for j in range(m):
                u[j] = gradient[j] * (world.gamma / np.sqrt(norm))
        value = _distances(center, columns, u, states, t, gradient)
        if value > best_value * (1.0 + TIE_MARGIN):
            best_value = value
            for j in range(m):
                best[j] = u[j]


@compiled
def _distances(center: Any, columns: Any, u: Any, states: Any, t: int, gradient: Any) -> float:
    """Return Σ_{s≤t} ‖x(u) - x_s‖ and write its gradient B Σ (x(u) - x_s)/‖x(u) - x_s‖, (m,)."""
    m, d = columns.shape
    point, direction = np.empty(d), np.zeros(d)
    for i in range(d):
        point[i] = center[i]
        for j in range(m):
            point[i] += u[j] * columns[j, i]
    total = 0.0
    for s in range(t + 1):
        square = 0.0
        for i in range(d):
            square += (point[i] - states[s, i]) ** 2
        if square > 0.0:
            norm = np.sqrt(square)
            total += norm
            for i in range(d):
                direction[i] += (point[i] - states[s, i]) / norm
    for j in range(m):
        gradient[j] = 0.0
        for i in range(d):
            gradient[j] += columns[j, i] * direction[i]
    return total
