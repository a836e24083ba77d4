"""One step of a Kalman filter over the state of a system with a learned model, in compiled code.

======  =========================================================  =======
symbol  meaning                                                    shape
======  =========================================================  =======
A       ∂x_{t+1}/∂x_t of the model's step                          d × d
P       covariance of the estimated state, given the parameters    d × d
Ψ       derivative of the estimated state by the parameters        d × q
c       row of C                                                   d
K, s    gain and variance of the innovation of an output           d, 1
======  =========================================================  =======
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.information.primal import add_multiple, inner
from dopt.kernel.integration import next_model_state
from dopt.kernel.structs import Network, Plant, Trial
from dopt.types import Integers, Matrix, Vector

DIFFERENCE = 1e-5
"""Change of a state, relative to its size and 1, over which derivatives are taken."""


@compiled
def state_jacobian(
    plant: Plant, network: Network, theta: Vector, x: Vector, u: Vector, dt: float
) -> Matrix:
    """Return A by central differences."""
    d = x.shape[0]
    A, ahead, behind, at = np.empty((d, d)), np.empty(d), np.empty(d), x.copy()
    for j in range(d):
        step = DIFFERENCE * max(1.0, abs(x[j]))
        at[j] = x[j] + step
        next_model_state(plant, network, theta, at, u, dt, ahead)
        at[j] = x[j] - step
        next_model_state(plant, network, theta, at, u, dt, behind)
        at[j] = x[j]
        for i in range(d):
            A[i, j] = (ahead[i] - behind[i]) / (2.0 * step)
    return A


@compiled
def begin(trial: Trial, t: int, P: Matrix, sensitivity: Matrix) -> bool:
    """Tell whether step t begins at a state of its own; P and Ψ are then those of that state."""
    if not np.isfinite(trial.state.estimate.starts[t, 0]):
        return False
    P[:] = np.diag(trial.sensors.start_variances)
    sensitivity[:] = 0.0
    return True


@compiled
def move_covariance(A: Matrix, noise: Matrix, rows: Integers, dt: float, P: Matrix) -> None:
    """Write A P Aᵀ + dt² E R Eᵀ, given the covariance R of the accelerations, (r, r)."""
    P[:] = np.dot(np.dot(A, P), A.T.copy())
    for k in range(rows.shape[0]):
        for i in range(rows.shape[0]):
            P[rows[k], rows[i]] += dt * dt * noise[k, i]


@compiled
def move_sensitivity(A: Matrix, J: Matrix, rows: Integers, dt: float, sensitivity: Matrix) -> None:
    """Write A Ψ + dt E J, given J, (r, q)."""
    sensitivity[:] = np.dot(A, sensitivity)
    for k in range(rows.shape[0]):
        add_multiple(sensitivity[rows[k]], dt, J[k])


@compiled
def covariances(P: Matrix, output: Vector) -> Vector:
    """Return P c, (d,), the covariances of the state with an output, given its row c of C, (d,)."""
    found = np.empty(P.shape[0])
    for i in range(P.shape[0]):
        found[i] = inner(P[i], output)
    return found


@compiled
def output_sensitivity(sensitivity: Matrix, output: Vector, row: Vector) -> None:
    """Write c Ψ, (q,), the derivative of an output by the parameters."""
    row[:] = 0.0
    for i in range(output.shape[0]):
        if output[i] != 0.0:
            add_multiple(row, output[i], sensitivity[i])


@compiled
def correct_covariance(P: Matrix, gain: Vector, variance: float) -> None:
    """Write P - K Kᵀ s, given K, (d,)."""
    d = P.shape[0]
    for i in range(d):
        for j in range(d):
            P[i, j] -= gain[i] * gain[j] * variance


@compiled
def correct_sensitivity(gain: Vector, row: Vector, sensitivity: Matrix) -> None:
    """Write Ψ - K c Ψ, given c Ψ, (q,)."""
    for i in range(gain.shape[0]):
        add_multiple(sensitivity[i], -gain[i], row)
