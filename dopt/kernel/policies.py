"""Closed-loop policies in compiled code: D-optimal (Algorithm 2) and uniform exploration."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from dopt.kernel.arguments import Network, State, World
from dopt.kernel.compiler import compiled
from dopt.kernel.model import gradient_and_changes, model_accelerations
from dopt.planning import sphere

for _helper in (sphere._easy_case, sphere._hard_case, sphere._with_norm, sphere.sphere_maximizer):
    numba.extending.register_jitable(_helper)

TIE_MARGIN = 1e-9
"""A second optimum has to be better by this relative margin: rounding must not choose."""


@compiled
def predicted_state(
    known: Any, accelerations: Any, world: World, network: Network, theta: Any, x: Any
) -> Any:
    """Return x̄ = x + dt f_θ(x, 0), (d,)."""
    flow = np.empty_like(x)
    known(x, np.zeros(world.n_inputs), world.parameters, flow)
    a = model_accelerations(accelerations, world, network, theta, x)
    for k in range(a.shape[0]):
        flow[world.learned_rows[k]] += a[k]
    return x + world.dt * flow


@compiled
def input_columns(known: Any, world: World, x: Any) -> Any:
    """Return the rows of Bᵀ = dt (∂f/∂u)ᵀ, (m, d), at a state; the input term is linear."""
    m = world.n_inputs
    base, flow = np.empty_like(x), np.empty_like(x)
    u = np.zeros(m)
    known(x, u, world.parameters, base)
    columns = np.empty((m, x.shape[0]))
    for j in range(m):
        u[:] = 0.0
        u[j] = 1.0
        known(x, u, world.parameters, flow)
        columns[j] = world.dt * (flow - base)
    return columns


@compiled
def d_optimal_input(
    known: Any,
    accelerations: Any,
    complex_accelerations: Any,
    world: World,
    network: Network,
    state: State,
    x: Any,
    component: int,
    tie: Any,
) -> Any:
    """Return the maximiser of (g + D B u)ᵀ M⁻¹ (g + D B u) on the sphere, (m,)."""
    bar = predicted_state(known, accelerations, world, network, state.theta, x)
    columns = input_columns(known, world, bar)
    m = columns.shape[0]
    G = np.empty((1 + m, state.theta.shape[0]))
    gradient_and_changes(
        accelerations,
        complex_accelerations,
        world,
        network,
        state.theta,
        bar,
        columns,
        component,
        G,
    )
    if m == 1:
        slope = np.dot(G[1], np.dot(state.covariance, G[0]))
        sign = 1.0 if slope > 0.0 or (slope == 0.0 and tie[0] > 0.0) else -1.0
        return np.full(1, sign * world.gamma)
    S = np.dot(np.dot(G, state.covariance), G.T)
    if not np.all(np.isfinite(S)):
        return np.full(m, np.nan)
    Q = np.ascontiguousarray(S[1:, 1:])
    return sphere.sphere_maximizer(Q, -S[0, 1:].copy(), world.gamma, tie)


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
) -> Any:
    """Return the best end point of gradient ascents of Σ_{s≤t} ‖x(u) - x_s‖ on the sphere."""
    x = states[t]
    center = predicted_state(known, accelerations, world, network, state.theta, x)
    columns = input_columns(known, world, x)
    m = columns.shape[0]
    best, best_value = np.zeros(m), -1.0
    for start in range(2 * m):
        u = np.zeros(m)
        u[start // 2] = world.gamma if start % 2 == 0 else -world.gamma
        if m > 1:
            for _ in range(steps):
                gradient = _distance_gradient(center, columns, u, states, t)
                norm = np.sqrt(np.sum(gradient * gradient))
                if norm == 0.0:
                    break
                u = gradient * (world.gamma / norm)
        value = _total_distance(center, columns, u, states, t)
        if value > best_value * (1.0 + TIE_MARGIN):
            best, best_value = u, value
    return best


@compiled
def _total_distance(center: Any, columns: Any, u: Any, states: Any, t: int) -> float:
    point = center + np.dot(u, columns)
    total = 0.0
    for s in range(t + 1):
        square = 0.0
        for i in range(point.shape[0]):
            square += (point[i] - states[s, i]) ** 2
        total += np.sqrt(square)
    return total


@compiled
def _distance_gradient(center: Any, columns: Any, u: Any, states: Any, t: int) -> Any:
    """Return ∇_u Σ_{s≤t} ‖x(u) - x_s‖ = B Σ (x(u) - x_s)/‖x(u) - x_s‖, (m,)."""
    point = center + np.dot(u, columns)
    total = np.zeros_like(point)
    for s in range(t + 1):
        square = 0.0
        for i in range(point.shape[0]):
            square += (point[i] - states[s, i]) ** 2
        if square > 0.0:
            weight = 1.0 / np.sqrt(square)
            for i in range(point.shape[0]):
                total[i] += (point[i] - states[s, i]) * weight
    return np.dot(columns, total)
