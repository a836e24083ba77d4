"""States of a recorded run of which some states are measured with noise, by a Kalman filter.

The filter over the state alone, with a model whose parameters stay
(:mod:`dopt.learning.joint_kalman` has its symbols): A P Aᵀ + dt² ρ E Eᵀ before a measurement, with
A by central differences.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dopt.control.prediction import Forecast, forecast_by
from dopt.systems.base import System
from dopt.systems.sensors import start_variances
from dopt.types import Array

DIFFERENCE = 1e-5
"""Change of a state, relative to its size and 1, over which derivatives are taken."""


def filtered_states(
    system: System,
    predict: Callable[[Array, Array], Array],
    outputs: Array,
    inputs: Array,
    noise_variance: float,
) -> Array:
    """Return estimates of the states, (T + 1, d), each from what was measured until then.

    Parameters
    ----------
    predict : callable
        Accelerations, (N, r), of states (N, d) under inputs (N, m).
    outputs, inputs : (T + 1, n), (T, m)
        Measured states, and the inputs between them. The other states are taken for 0 at first, up
        to the half-width of the box, or 1.
    noise_variance : float
        ρ, the variance of the accelerations that the model leaves out.
    """
    forecast, measured = forecast_by(system, predict), list(system.measured_states)
    states, P = np.zeros((len(outputs), system.n_states)), np.diag(start_variances(system))
    states[0, measured] = outputs[0]
    Q, R = np.zeros_like(P), np.diag(np.square(system.measurement_noise))
    Q[system.learned_rows, system.learned_rows] = system.dt**2 * noise_variance
    for t, u in enumerate(inputs):
        x, A = _step(forecast, states[t], u)
        P = A @ P @ A.T + Q
        S = P[np.ix_(measured, measured)] + R
        gain = np.linalg.solve(S, P[measured]).T
        states[t + 1] = x + gain @ (outputs[t + 1] - x[measured])
        P = P - gain @ P[measured]
        P = 0.5 * (P + P.T)
    return states


def _step(forecast: Forecast, x: Array, u: Array) -> tuple[Array, Array]:
    """Return the state that follows, (d,), and its derivative A by the state, (d, d)."""
    d = len(x)
    steps = np.diag(DIFFERENCE * np.maximum(1.0, np.abs(x)))
    at = np.concatenate([x[None], x + steps, x - steps])
    following = forecast(at, np.broadcast_to(u, (len(at), 1, len(u))))[0]
    ahead, behind = following[1 : d + 1], following[d + 1 :]
    return following[0], ((ahead - behind) / (2.0 * np.diag(steps))[:, None]).T
