"""D-optimal exploration (Algorithm 2) in compiled code (:mod:`dopt.policies.d_optimal`).

Its number is 1 where all learned components count at each step, and 0 where one is drawn.
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import Form, ModelKind
from dopt.kernel.compiler import compilable, compiled
from dopt.kernel.information.dual import dual_forms
from dopt.kernel.information.primal import quadratic_forms
from dopt.kernel.information.sketch import sketched
from dopt.kernel.model import linear_gradients, linearization_at, network_gradients
from dopt.kernel.policies.prediction import input_columns, predicted_state
from dopt.kernel.structs import Algorithm, Network, Plant, State, Trial
from dopt.math.sphere import sphere_maximizer
from dopt.types import Matrix, Vector

compilable(sphere_maximizer)


@compiled
def planning_forms(
    plant: Plant,
    network: Network,
    algorithm: Algorithm,
    state: State,
    bar: Vector,
    columns: Matrix,
    component: int,
) -> Matrix:
    """Return xᵀM⁻¹y for x and y among g and the columns of D B, (1 or 1 + m, 1 + m).

    With one input the quadratic term of equation 7 is constant on the sphere: the row of g is
    enough and costs one product with M⁻¹.
    """
    q, m = state.theta.shape[0], columns.shape[0]
    if network.kind == ModelKind.LINEAR:
        G = linear_gradients(plant, q, bar, columns, component)
    else:
        a = np.empty(plant.learned_rows.shape[0])
        point = linearization_at(network, state.theta, bar, columns, component, a)
        if algorithm.form == Form.DUAL:
            return dual_forms(state.dual, algorithm.regularization, point, component)
        G = network_gradients(network, point, component, q)
        if algorithm.form == Form.SKETCH:
            G = sketched(state.sketch, G)
    return quadratic_forms(state.covariance, G[: 1 if m == 1 else 1 + m], G)


@compiled
def plan(trial: Trial, t: int, u: Vector) -> None:
    """Write the maximiser of (g + D B u)ᵀ M⁻¹ (g + D B u), or its sum, on the sphere, (m,)."""
    plant, network, algorithm, state = trial.plant, trial.network, trial.algorithm, trial.state
    all_components = algorithm.policy[0] != 0.0
    component, tie = trial.randomness.components[t], trial.randomness.ties[t]
    bar = predicted_state(plant, network, state.theta, trial.record.states[t])
    columns = input_columns(plant, bar)
    m = columns.shape[0]
    S = np.zeros((1 if m == 1 else 1 + m, 1 + m))
    for k in range(plant.learned_rows.shape[0]):
        if all_components or k == component:
            forms = planning_forms(plant, network, algorithm, state, bar, columns, k)
            for i in range(S.shape[0]):
                for j in range(S.shape[1]):
                    S[i, j] += forms[i, j]
    if m == 1:
        up = S[0, 1] > 0.0 or (S[0, 1] == 0.0 and tie[0] > 0.0)
        u[0] = plant.gamma if up else -plant.gamma
        return
    Q, v = np.empty((m, m)), np.empty(m)
    for i in range(m):
        v[i] = -S[0, 1 + i]
        for j in range(m):
            Q[i, j] = S[1 + i, 1 + j]
    chosen = sphere_maximizer(Q, v, plant.gamma, tie)
    for i in range(m):
        u[i] = chosen[i]
