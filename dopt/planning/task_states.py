"""The states in which a task needs a good model."""

from __future__ import annotations

import functools

import numpy as np

from dopt.evaluation import evaluation_set
from dopt.policies.base import Array
from dopt.policies.task import TaskOptimal
from dopt.systems.base import System

_SEED = 20_260_101


@functools.lru_cache(maxsize=64)
def task_states(system: System, task: TaskOptimal) -> Array:
    """Return states, (≤ count, d), drawn without replacement by their weights; always the same."""
    points = evaluation_set(system)
    part = slice(points.n_grid, None) if task.states == "reachable" else slice(points.n_grid)
    states = points.states[part]
    weights = goal_weights(system, task, states)
    rng = np.random.default_rng(_SEED)
    count = min(task.count, int(np.count_nonzero(weights)))
    chosen = rng.choice(len(states), count, replace=False, p=weights / weights.sum())
    return np.ascontiguousarray(states[np.sort(chosen)])


def goal_weights(system: System, task: TaskOptimal, states: Array) -> Array:
    """Return exp(-δ²/2) of states, (N,), with δ the distance to the goal in units of ``radius``.

    The components of the evaluation grid count, each by its half-width; angles are taken on the
    circle. Far from every state the nearest still has the weight 1.
    """
    if not task.goal:
        return np.ones(len(states))
    squares = np.zeros(len(states))
    for index, half_width in zip(system.grid_indices, system.grid_half_widths, strict=True):
        gap = states[:, index] - task.goal[index]
        if index in system.angle_indices:
            gap = (gap + np.pi) % (2 * np.pi) - np.pi
        squares += (gap / (task.radius * half_width)) ** 2
    weights: Array = np.exp(-0.5 * (squares - squares.min()))
    return weights
