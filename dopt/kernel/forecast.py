"""Forecasts of many paths at once, under a model or the truth (:mod:`dopt.control.planning`).

Sizes beside :mod:`dopt.kernel.structs`: H steps, n paths.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import float64

from dopt.control.planning import Forecast
from dopt.kernel import network as nn
from dopt.kernel.compiler import called_from_python
from dopt.kernel.from_spec import plant_of
from dopt.kernel.held import HeldPlant, HeldPlantType, hold_plant
from dopt.kernel.integration import add_stage, n_stages, next_true_state, write_rate
from dopt.kernel.model import write_point_features
from dopt.kernel.pointers import compiled_for, kind_of
from dopt.kernel.state_from_spec import network_of
from dopt.kernel.structs import Network
from dopt.models import MLP
from dopt.models.base import Model
from dopt.systems.base import System
from dopt.types import Array, Matrix, Stack, Vector


@called_from_python
def follow_equations(held: HeldPlant, parameters: Vector, inputs: Stack, states: Stack) -> None:
    """Write the states, (H + 1, n, d), that follow the first under inputs (H, n, m)."""
    plant = held.plant
    for t in range(inputs.shape[0]):
        for i in range(inputs.shape[1]):
            next_true_state(plant, parameters, states[t, i], inputs[t, i], states[t + 1, i])


@called_from_python
def follow_network(
    held: HeldPlant, network: Network, thetas: Matrix, inputs: Stack, states: Stack
) -> None:
    """Write the states, (H + 1, n, d), that follow the first under inputs (H, n, m).

    They follow the mean of the networks with parameters ``thetas``, (E, q).
    """
    plant = held.plant
    n, d, r = inputs.shape[1], states.shape[2], plant.learned_rows.shape[0]
    depth, width = network.offsets.shape[0] - 1, network.sizes[1]
    rate, value, total = np.empty(d), np.empty(r), np.empty((n, d))
    features, outputs = np.empty((network.feature_kinds.shape[0], n)), np.empty((r, n))
    one = np.empty((r, n))
    hidden = np.empty((depth, width * n))
    for t in range(inputs.shape[0]):
        states[t + 1] = states[t]
        for stage in range(n_stages(plant)):
            write_point_features(network, states[t + 1], inputs[t], features)
            nn.mean_forward(network, thetas, features, hidden, outputs, one)
            for i in range(n):
                x, following = states[t, i], states[t + 1, i]
                for k in range(r):
                    value[k] = outputs[k, i]
                write_rate(plant, following, inputs[t, i], value, rate)
                add_stage(plant, stage, plant.dt, x, rate, total[i], following)


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
