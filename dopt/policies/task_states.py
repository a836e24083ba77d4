"""Draw of the states at which a task needs an accurate model."""

from __future__ import annotations

import functools

import numpy as np

from dopt.evaluation import reachable_states
from dopt.policies.base import Array
from dopt.policies.search import TaskOptimal
from dopt.systems.base import System

DRAWN = 4096
"""States of the box among which a task's are chosen."""

_SEED = 20_260_101


@functools.lru_cache(maxsize=64)
def task_states(system: System, task: TaskOptimal) -> Array:
    """Return states, (≤ count, d), drawn without replacement by their weights; always the same."""
    rng = np.random.default_rng(_SEED)
    states = reachable_states(system) if task.states == "reachable" else _box(system, rng)
    weights = goal_weights(system, task, states)
    count = min(task.count, int(np.count_nonzero(weights)))
    chosen = rng.choice(len(states), count, replace=False, p=weights / weights.sum())
    return np.ascontiguousarray(states[np.sort(chosen)])


@functools.lru_cache(maxsize=64)
def box_states(system: System) -> Array:
    """Return states, (4096, d), uniform in the evaluation box; always the same."""
    return _box(system, np.random.default_rng(_SEED))


def _box(system: System, rng: np.random.Generator) -> Array:
    """Return states, (4096, d), uniform in the evaluation box; the other components are zero."""
    low, high = np.array(list(system.grid_box().values())).T
    states = np.zeros((DRAWN, system.n_states))
    states[:, list(system.grid_indices)] = rng.uniform(low, high, (DRAWN, len(low)))
    return states


def domain_box(system: System, domain: str) -> Array:
    """Return half-widths and periods of the components of a state, (2, d).

    With ``domain`` "box" the half-widths are the evaluation box's, and ∞ for the components
    that it leaves free; with "everywhere" all are ∞. The period is 2π for angles, 0 for all others.
    """
    out = np.zeros((2, system.n_states))
    out[0] = np.inf
    if domain == "box":
        out[0, list(system.grid_indices)] = system.grid_half_widths
    out[1, list(system.angle_indices)] = 2 * np.pi
    return out


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
        squares += (gap / half_width) ** 2
    with np.errstate(over="ignore"):
        weights: Array = np.exp(-0.5 * ((squares - squares.min()) / task.radius / task.radius))
    return weights
