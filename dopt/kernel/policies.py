"""Policies without a search, in compiled code (:mod:`dopt.policies`).

D-optimal exploration (Algorithm 2): ``algorithm.policy[0]`` is 1 if all learned components count at
each step, 0 if one is drawn. For a model that reads inputs the input of the next sample is drawn as
well: uniformly on the sphere, or from the ball for a model that is not affine in the inputs, whose
planned inputs have drawn norms. Uniform exploration: the number is the count of ascent steps.

Predictive entropy of held candidates: C candidates, H steps for which one is held.
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import TIE_MARGIN
from dopt.kernel import gaussian_process as gp
from dopt.kernel.compiler import compilable, compiled, copy_into, squared
from dopt.kernel.integration import arrival_columns, arrival_state, point_columns, predicted_state
from dopt.kernel.linear_algebra import factorize
from dopt.kernel.model import model_point
from dopt.kernel.search import roll
from dopt.kernel.structs import Trial
from dopt.kernel.vectors import inner
from dopt.sphere import sphere_maximizer
from dopt.types import Matrix, Vector


@compiled
def plan_drawn(trial: Trial, t: int, u: Vector) -> None:
    """Write the input u_t, (m,), as it was drawn."""
    copy_into(trial.randomness.inputs[t], u)


compilable(sphere_maximizer)


@compiled
def plan_d_optimal(trial: Trial, t: int, u: Vector) -> None:
    """Write the maximiser of (g + D B u)ᵀ M⁻¹ (g + D B u), or its sum, on a sphere, (m,)."""
    plant, network, state = trial.plant, trial.network, trial.state
    all_components = trial.algorithm.policy[0] != 0.0
    component, tie = trial.randomness.components[t], trial.randomness.ties[t]
    x = arrival_state(plant, network, state.theta, trial.record.states[t])
    center = predicted_state(plant, network, state.theta, x)
    columns = point_columns(network, arrival_columns(plant, network, state.theta, center))
    radii: Vector = plant.gamma * trial.randomness.radii[t]
    m, bar = columns.shape[0], model_point(network, center, on_sphere(tie, radii[1]))
    S = np.zeros((1 if m == 1 else 1 + m, 1 + m))
    for k in range(plant.learned_rows.shape[0]):
        if all_components or k == component:
            forms = trial.information.planning_forms(plant, network, state, bar, columns, k)
            for i in range(S.shape[0]):
                for j in range(S.shape[1]):
                    S[i, j] += forms[i, j]
    if m == 1:
        up = S[0, 1] > 0.0 or (S[0, 1] == 0.0 and tie[0] > 0.0)
        u[0] = radii[0] if up else -radii[0]
        return
    Q, v = np.empty((m, m)), np.empty(m)
    for i in range(m):
        v[i] = -S[0, 1 + i]
        for j in range(m):
            Q[i, j] = S[1 + i, 1 + j]
    copy_into(sphere_maximizer(Q, v, radii[0], tie), u)


@compiled
def on_sphere(direction: Vector, radius: float) -> Vector:
    """Return the vector of a norm along a direction, (m,)."""
    scaled: Vector = direction * (radius / np.sqrt(inner(direction, direction)))
    return scaled


@compiled
def plan_uniform(trial: Trial, t: int, u: Vector) -> None:
    """Write the best end point of gradient ascents of Σ_{s≤t} ‖x(u) - x_s‖ on the sphere."""
    plant, states, steps = trial.plant, trial.record.states, int(trial.algorithm.policy[0])
    x = arrival_state(plant, trial.network, trial.state.theta, states[t])
    center = predicted_state(plant, trial.network, trial.state.theta, x)
    columns = arrival_columns(plant, trial.network, trial.state.theta, x)
    columns = np.ascontiguousarray(columns[:, : x.shape[0] - plant.n_carried])
    m = columns.shape[0]
    best_value = -1.0
    tried, gradient = np.empty(m), np.empty(m)
    for start in range(2 * m):
        for j in range(m):
            tried[j] = 0.0
        tried[start // 2] = plant.gamma if start % 2 == 0 else -plant.gamma
        for _ in range(steps if m > 1 else 0):
            _distances(center, columns, tried, states, t, gradient)
            norm = 0.0
            for j in range(m):
                norm += gradient[j] * gradient[j]
            if norm == 0.0:
                break
            for j in range(m):
                tried[j] = gradient[j] * (plant.gamma / np.sqrt(norm))
        value = _distances(center, columns, tried, states, t, gradient)
        if value > best_value * (1.0 + TIE_MARGIN):
            best_value = value
            copy_into(tried, u)


@compiled
def _distances(
    center: Vector, columns: Matrix, u: Vector, states: Matrix, t: int, gradient: Vector
) -> float:
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
            square += squared(point[i] - states[s, i])
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


@compiled
def plan_held_candidates(trial: Trial, t: int, u: Vector) -> None:
    """Write the candidate of the largest entropy, (m,); of equal ones the first."""
    plant, network, search, state = trial.plant, trial.network, trial.algorithm.search, trial.state
    (C, m), H = search.candidates.shape, search.steps
    starts, held = np.empty((C, trial.record.states.shape[1])), search.candidates.reshape(C, 1, m)
    starts[:] = trial.record.states[t]
    rolled = roll(plant, network, state.theta, starts, held, np.zeros(H, np.int64), 0, 1)
    # Components that share a kernel have the same entropy.
    r = plant.learned_rows.shape[0] if network.process.shared.shape[0] == 0 else 1
    rows = np.empty((C * H * r, network.process.n_samples[0]))
    features = np.empty((C * H * r, network.sizes[0]))
    gp.write_rows(network, state, r, rolled.points, rows, features)
    numbers = gp.numbers_by_row(network, state.theta, r)
    best, covariance = -np.inf, np.empty((H * r, H * r))
    u[:] = search.candidates[0]
    for c in range(C):
        first = c * H * r
        for i in range(H * r):
            for j in range(i, H * r):
                covariance[i, j] = gp.information(numbers, features, rows, first + i, first + j)
            covariance[i, i] += 1.0
        # Rounding may leave it indefinite.
        value = 2.0 * np.log(np.diag(covariance)).sum() if factorize(covariance) else -np.inf
        if value > best:
            best = value
            u[:] = search.candidates[c]
