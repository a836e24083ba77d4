"""Paths of the learned model that advance together, in compiled code.

Legend beside :mod:`dopt.kernel.structs`: P paths, K inputs of a path, n states of a path that are
kept. The model is evaluated at all paths at once, which costs less than one after the other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.kernel.checks import within
from dopt.kernel.compiler import compiled
from dopt.kernel.model import accelerations_at, euler_step
from dopt.kernel.points import n_next_points, next_points
from dopt.kernel.structs import Network, Plant
from dopt.types import Booleans, Matrix, Stack, Vector


class Paths(NamedTuple):
    """Paths at their present step; written in place."""

    states: Matrix  # (P, d)
    inside: Booleans  # (P,), whether all states so far are within bounds
    points: Matrix  # (P, ·), what the model depends on: the states, or states and inputs
    outputs: Matrix  # (r, P), a_θ there
    value: Vector  # (r,), of one path
    flow: Vector  # (d,)
    following: Vector  # (d,)


@compiled
def paths_from(plant: Plant, network: Network, starts: Matrix) -> Paths:
    """Return paths that start at states, (P, d)."""
    (P, d), r = starts.shape, plant.learned_rows.shape[0]
    states = starts.copy()
    return Paths(
        states,
        np.ones(P, np.bool_),
        states if network.n_inputs_read == 0 else np.empty((P, d + network.n_inputs_read)),
        np.empty((r, P)),
        np.empty(r),
        np.empty(d),
        np.empty(d),
    )


@compiled
def advance_paths(
    plant: Plant, network: Network, theta: Vector, paths: Paths, inputs: Stack, k: int
) -> None:
    """Take every path one step x + dt f_θ(x, u) further under its k-th input of (P, K, m)."""
    P, d = paths.states.shape
    if network.n_inputs_read > 0:
        paths.points[:, :d] = paths.states
        paths.points[:, d:] = inputs[:, k]
    accelerations_at(plant, network, theta, paths.points, paths.outputs)
    for p in range(P):
        for j in range(paths.value.shape[0]):
            paths.value[j] = paths.outputs[j, p]
        euler_step(plant, paths.states[p], inputs[p, k], paths.value, paths.flow, paths.following)
        paths.inside[p] = paths.inside[p] and within(paths.following, plant.state_limit)
        for j in range(d):
            paths.states[p, j] = paths.following[j]


@compiled
def keep_points(plant: Plant, network: Network, paths: Paths, i: int, n: int, kept: Matrix) -> None:
    """Write the points of the present states as the i-th of n of every path.

    They are :func:`dopt.kernel.points.next_points`, path by path.
    """
    per_state = n_next_points(network)
    for p in range(paths.states.shape[0]):
        place = per_state * (p * n + i)
        points = next_points(network, paths.states[p], plant.gamma)
        kept[place : place + per_state] = points
