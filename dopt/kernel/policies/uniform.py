"""Uniform exploration in compiled code (:mod:`dopt.policies.d_optimal`).

Its number is the count of ascent steps.
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import TIE_MARGIN
from dopt.kernel.compiler import compiled, squared
from dopt.kernel.policies.prediction import learned_columns, predicted_state
from dopt.kernel.structs import Trial
from dopt.types import Matrix, Vector


@compiled
def plan(trial: Trial, t: int, u: Vector) -> None:
    """Write the best end point of gradient ascents of Σ_{s≤t} ‖x(u) - x_s‖ on the sphere."""
    plant, states, steps = trial.plant, trial.record.states, int(trial.algorithm.policy[0])
    x = states[t]
    center = predicted_state(plant, trial.network, trial.state.theta, x)
    columns = learned_columns(plant, trial.network, trial.state.theta, x)
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
            for j in range(m):
                u[j] = tried[j]


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
