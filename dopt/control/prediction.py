"""Prediction of many states over many steps, with true or modelled accelerations."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from dopt.systems.base import System
from dopt.systems.integration import next_state

Array = npt.NDArray[np.float64]

Accelerations = Callable[[Array, Array], Array]
"""Accelerations (N, r) of states (N, d) under inputs (N, m)."""

Forecast = Callable[[Array, Array], Array]
"""States (H, N, d) after each step, from states (N, d) under inputs (N, H, m)."""


def forecast_by(system: System, accelerations: Accelerations) -> Forecast:
    """Return the forecast of a system by accelerations that any function gives."""
    return lambda states, inputs: predict(system, accelerations, states, inputs)


def forecast_by_equations(system: System) -> Forecast:
    """Return the forecast of the system itself as it is at the first step, without noise."""
    return forecast_by(system, lambda states, inputs: system.learned(states, inputs=inputs))


def predict(system: System, accelerations: Accelerations, states: Array, inputs: Array) -> Array:
    """Return the states, (H, N, d), after each step from states (N, d) under inputs (N, H, m).

    The system's integrator without noise; numbers that overflow become infinite or NaN.
    """
    if system.integrator != "euler":
        return _predict_in_stages(system, accelerations, states, inputs)
    by_step = np.ascontiguousarray(np.moveaxis(inputs, (1, 2), (0, 1)))
    visited = np.empty((len(by_step) + 1, system.n_states, len(states)))
    visited[0] = states.T
    rows = list(system.learned_rows)
    with np.errstate(over="ignore", invalid="ignore"):
        for x, u, following in zip(visited, by_step, visited[1:], strict=False):
            for row, known in enumerate(system.known(tuple(x), tuple(u), system.parameters)):
                following[row] = known
            following[rows] += accelerations(x.T, u.T).T
            following *= system.dt
            following += x
    return visited[1:].swapaxes(1, 2)


def _predict_in_stages(
    system: System, accelerations: Accelerations, states: Array, inputs: Array
) -> Array:
    visited = np.empty((inputs.shape[1] + 1, *states.shape))
    visited[0] = states
    with np.errstate(over="ignore", invalid="ignore"):
        for t in range(inputs.shape[1]):
            rate = functools.partial(_rate, system, accelerations, inputs[:, t])
            visited[t + 1] = next_state(system.integrator, rate, visited[t], system.dt)
    return visited[1:]


def _rate(system: System, accelerations: Accelerations, inputs: Array, states: Array) -> Array:
    """Return dx/dt, (N, d), of states (N, d) under inputs (N, m)."""
    known = system.known(tuple(states.T), tuple(inputs.T), system.parameters)
    rate = np.stack(np.broadcast_arrays(*known, states[:, 0])[:-1], axis=-1)
    rate[:, list(system.learned_rows)] += accelerations(states, inputs)
    return rate
