"""Forecasts of many paths at once, under a model or the truth (:mod:`dopt.control.planning`)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import float64

from dopt.control.planning import Forecast
from dopt.kernel.from_spec import plant_of
from dopt.kernel.held import HeldPlantType, hold_plant
from dopt.kernel.integration import (
    follow_equations,
    follow_network,
)
from dopt.kernel.pointers import compiled_for, kind_of
from dopt.kernel.state_from_spec import network_of
from dopt.models import MLP
from dopt.models.base import Model
from dopt.systems.base import System
from dopt.types import Array


def true_forecast(system: System) -> Forecast:
    """Return the forecast of the system itself, as it is at the first step."""
    return _by_equations(system, system.history[0])


def model_forecast(system: System, model: Model, parameters: Array) -> Forecast:
    """Return the forecast of a model of the kernel with parameters (q,)."""
    if isinstance(model, MLP):
        thetas = np.reshape(parameters, (model.n_members, -1)).copy()
        given = (network_of(system, model), thetas)
        return _forecast("follow-network", follow_network, system, given)
    # The accelerations are affine in θ, so that the linear model is the system with θ for its own.
    offset, *units = np.array(system.linear_form)
    return _by_equations(system, offset + parameters @ (np.array(units) - offset))


def _by_equations(system: System, parameters: Array) -> Forecast:
    return _forecast("follow-equations", follow_equations, system, (np.array(parameters),))


def _forecast(
    name: str, function: Callable[..., None], system: System, given: tuple[object, ...]
) -> Forecast:
    plant = plant_of(system)
    kind = kind_of(plant)
    held = compiled_for("hold-plant", hold_plant, (kind,))(plant)
    kinds = (HeldPlantType([("plant", kind)]), *map(kind_of, given), *[float64[:, :, ::1]] * 2)
    follow = compiled_for(name, function, kinds)

    def forecast(states: Array, inputs: Array) -> Array:
        n, steps, _ = inputs.shape
        visited = np.empty((steps + 1, n, states.shape[1]))
        visited[0] = states
        by_step = np.ascontiguousarray(inputs.swapaxes(0, 1))
        follow(held, *given, by_step, visited)
        return visited[1:]

    return forecast
