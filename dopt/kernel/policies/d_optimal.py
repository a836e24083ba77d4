"""D-optimal exploration (Algorithm 2) in compiled code (:mod:`dopt.policies.d_optimal`).

``algorithm.policy[0]`` is 1 if all learned components count at each step, 0 if one is drawn. For a
model that reads inputs the input of the next sample is drawn as well: uniformly on the sphere, or
from the ball for a model that is not affine in the inputs, whose planned inputs have drawn norms.
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compilable, compiled
from dopt.kernel.information.primal import inner
from dopt.kernel.points import model_point
from dopt.kernel.policies.prediction import learned_columns, point_columns, predicted_state
from dopt.kernel.structs import Trial
from dopt.sphere import sphere_maximizer
from dopt.types import Vector

compilable(sphere_maximizer)


@compiled
def plan(trial: Trial, t: int, u: Vector) -> None:
    """Write the maximiser of (g + D B u)ᵀ M⁻¹ (g + D B u), or its sum, on a sphere, (m,)."""
    plant, network, state = trial.plant, trial.network, trial.state
    all_components = trial.algorithm.policy[0] != 0.0
    component, tie = trial.randomness.components[t], trial.randomness.ties[t]
    center = predicted_state(plant, network, state.theta, trial.record.states[t])
    columns = point_columns(network, learned_columns(plant, network, state.theta, center))
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
    chosen = sphere_maximizer(Q, v, radii[0], tie)
    for i in range(m):
        u[i] = chosen[i]


@compiled
def on_sphere(direction: Vector, radius: float) -> Vector:
    """Return the vector of a norm along a direction, (m,)."""
    scaled: Vector = direction * (radius / np.sqrt(inner(direction, direction)))
    return scaled
