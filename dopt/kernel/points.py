"""Points in compiled code: what learned accelerations and their model depend on.

They are states, (d,), or states and inputs, (d + m,).
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import Integrator
from dopt.kernel.compiler import compiled, copy_into
from dopt.kernel.structs import Network, Plant
from dopt.types import Matrix, Vector


@compiled
def plant_point(plant: Plant, x: Vector, u: Vector) -> Vector:
    """Return what the true accelerations depend on at a state and an input."""
    return joined(x, u, plant.n_inputs_read)


@compiled
def model_point(network: Network, x: Vector, u: Vector) -> Vector:
    """Return what the model depends on at a state and an input."""
    return joined(x, u, network.n_inputs_read)


@compiled
def sampled_state(plant: Plant, states: Matrix, t: int) -> Vector:
    """Return where the accelerations of step t are observed, given the states x_0 ... x_T."""
    return state_between(plant, states[t], states[t + 1])


@compiled
def state_between(plant: Plant, x: Vector, following: Vector) -> Vector:
    """Return where the accelerations of a step are observed: at its start, or in its middle.

    See :meth:`dopt.systems.base.System.sampled_states`.
    """
    if plant.integrator == Integrator.EULER:
        return x
    middle: Vector = 0.5 * (x + following)
    return middle


@compiled
def joined(x: Vector, u: Vector, n_inputs_read: int) -> Vector:
    """Return a state, or a copy with the input behind it."""
    if n_inputs_read == 0:
        return x
    d = x.shape[0]
    point = np.empty(d + n_inputs_read)
    copy_into(x, point[:d])
    copy_into(u, point[d:])
    return point


@compiled
def n_next_points(network: Network) -> int:
    """Return how many points stand for a state whose input is not chosen yet: 1 or 2 m."""
    return max(1, 2 * network.n_inputs_read)


@compiled
def next_points(network: Network, x: Vector, gamma: float) -> Matrix:
    """Return points that stand for a state whose input is not chosen yet.

    These are the state itself, (1, d), or for a model that reads inputs the state under ±γ along
    each axis, (2 m, d + m). The mean of JᵀJ over them is that over the sphere ‖u‖ = γ where J is
    affine in u.
    """
    d, m = x.shape[0], network.n_inputs_read
    points = np.zeros((n_next_points(network), d + m))
    points[:, :d] = x
    for j in range(m):
        points[2 * j, d + j] = gamma
        points[2 * j + 1, d + j] = -gamma
    return points
