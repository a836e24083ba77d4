"""Forecasts for planners that roll thousands of paths: twin of :mod:`dopt.control.prediction`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numba
import numpy as np
from numba import float64

from dopt.control.prediction import Forecast
from dopt.kernel.arguments import Floats
from dopt.kernel.equations import ACCELERATIONS, KNOWN, compiled_equations
from dopt.kernel.loop import compiled_for, pointer
from dopt.kernel.rollout import follow_equations, follow_network
from dopt.kernel.setup import network_of, world_of
from dopt.models import MLP
from dopt.models.base import Model
from dopt.systems.base import System


def true_forecast(system: System) -> Forecast:
    """Return the forecast of the system itself, as it is at the first step."""
    return _by_equations(system, system.history[0])


def model_forecast(system: System, model: Model, parameters: Floats) -> Forecast:
    """Return the forecast of a model of the kernel with parameters (q,)."""
    if isinstance(model, MLP):
        given = (world_of(system), network_of(system, model), np.array(parameters))
        known = compiled_equations(system).known
        return _forecast("follow-network", follow_network, {KNOWN: known}, given)
    # The accelerations are affine in θ, so that the linear model is the system with θ for its own.
    offset, *units = np.array(system.linear_form)
    return _by_equations(system, offset + parameters @ (np.array(units) - offset))


def _by_equations(system: System, parameters: Floats) -> Forecast:
    equations = compiled_equations(system)
    pointers = {KNOWN: equations.known, ACCELERATIONS: equations.accelerations}
    given = (world_of(system), np.array(parameters))
    return _forecast("follow-equations", follow_equations, pointers, given)


def _forecast(
    name: str, function: Any, pointers: Mapping[Any, Any], given: tuple[Any, ...]
) -> Forecast:
    kinds = [*map(pointer, pointers), *map(numba.typeof, given), *[float64[:, :, ::1]] * 2]
    follow = compiled_for(name, function, tuple(kinds))

    def forecast(states: Floats, inputs: Floats) -> Floats:
        n, steps, _ = inputs.shape
        visited = np.empty((steps + 1, n, states.shape[1]))
        visited[0] = states
        by_step = np.ascontiguousarray(inputs.swapaxes(0, 1))
        follow(*pointers.values(), *given, by_step, visited)
        return visited[1:]

    return forecast
