"""Points of a system: the evaluation grid, the reachable set, and what a task needs accurate."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dopt.policies.base import ball_norms, on_sphere
from dopt.systems.base import System, next_state
from dopt.systems.black_box import BlackBox, transitions
from dopt.systems.properties import eigenmode
from dopt.types import Array

if TYPE_CHECKING:
    from dopt.policies.search import TaskOptimal

REACHABLE_POINTS = 512
LONGEST_RUN = 2_000
"""Steps of the runs from which the reachable set is drawn, if the horizon is longer than that."""

HELD_STEPS = (5, 10, 20, 40)
FREQUENCY_RATIOS = (0.8, 1.0, 1.2)
CHIRP_RANGE = (0.2, 2.0)
_SEED = 20_230_131


@dataclass(frozen=True)
class EvaluationSet:
    """States and the true accelerations there at the first step, the grid's first.

    Attributes
    ----------
    states : (N, d)
    inputs : (N, m)
        At the points of the grid they are uniform in the ball ‖u‖ ≤ γ, elsewhere those under which
        the states were visited. They count where the system or the model reads inputs.
    accelerations : (N, r)
    n_grid : int
        Number of grid points; the other points are the reachable set.
    """

    states: Array
    inputs: Array
    accelerations: Array
    n_grid: int


@functools.lru_cache(maxsize=64)
def evaluation_set(system: System) -> EvaluationSet:
    """Return the points of a system; a function of its parameters alone.

    Of a black box they are held-out transitions: in place of the reachable set those under square
    waves and a chirp, and in place of the grid those under random inputs, unless the black box
    tells the truth there.
    """
    if isinstance(system, BlackBox):
        return _held_out(system)
    grid = system.grid()
    reached, applied = reachable_points(system)
    states = np.concatenate([grid, reached])
    inputs = np.concatenate([_in_ball(system, len(grid)), applied])
    return EvaluationSet(states, inputs, system.learned(states, inputs=inputs), len(grid))


def _in_ball(system: System, n: int) -> Array:
    """Return inputs, (n, m), uniform in the ball ‖u‖ ≤ γ; always the same."""
    rng, m = np.random.default_rng(_SEED), system.n_inputs
    directions = on_sphere(rng.standard_normal((n, m)), system.gamma)
    return directions * ball_norms(rng, (n, 1), m)


def _held_out(system: BlackBox) -> EvaluationSet:
    """Return transitions of runs that no trial sees, with fixed seeds, or the truth on the grid."""
    rng = np.random.default_rng(_SEED)
    states = system.grid()
    inputs = _in_ball(system, len(states))
    truth = system.true_accelerations(states, inputs)
    grid = (
        random_transitions(system, len(states), rng) if truth is None else (states, inputs, truth)
    )
    waves = _sampled(system, _waves(system), REACHABLE_POINTS, rng)
    states, inputs, accelerations = (
        np.concatenate(parts) for parts in zip(grid, waves, strict=True)
    )
    return EvaluationSet(states, inputs, accelerations, len(grid[0]))


def random_transitions(
    system: BlackBox, wanted: int, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Return states (N, d), inputs (N, m) and accelerations (N, r) of at most so many transitions.

    They are drawn without replacement from runs under random inputs of the strength of a trial's.
    """
    rounds = math.ceil(2 * wanted / (len(HELD_STEPS) * run_steps(system)))
    held = [sequence for _ in range(rounds) for sequence in _held(system, rng)]
    return _sampled(system, held, wanted, rng)


def _sampled(
    system: BlackBox, sequences: list[Array], wanted: int, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Return states (N, d), inputs (N, m) and accelerations (N, r) of at most so many."""
    runs = [transitions(system, inputs, seed) for seed, inputs in enumerate(sequences)]
    states, inputs, accelerations, there = (
        np.concatenate(parts) for parts in zip(*runs, strict=True)
    )
    found = np.flatnonzero(there)
    chosen = np.sort(rng.choice(found, min(wanted, len(found)), replace=False))
    return states[chosen], inputs[chosen], accelerations[chosen]


def reachable_states(system: System) -> Array:
    """Return the states of :func:`reachable_points`, (512, d)."""
    return reachable_points(system)[0]


def reachable_points(system: System) -> tuple[Array, Array]:
    """Return states, (512, d), that the true system visits under strong inputs of full energy.

    With them come the inputs that are applied there, (512, m), 0 after the last step of a run. The
    inputs are random ones held for 5, 10, 20 and 40 steps, square waves at and around the
    eigenfrequency and one of rising frequency, each over the horizon, at most
    :data:`LONGEST_RUN` steps, without process noise. They are of the kind of two baselines,
    ``random_held`` and ``periodic_square``, which visit similar states. The sample
    is drawn without replacement from all states visited, with a fixed seed.
    """
    rng = np.random.default_rng(_SEED)
    states, inputs = visited_points(system, rng)
    found = rng.choice(len(states), min(REACHABLE_POINTS, len(states)), replace=False)
    chosen = np.sort(found)
    return states[chosen], inputs[chosen]


def run_steps(system: System) -> int:
    """Return the number of steps T of a run from which the reachable set is drawn."""
    return min(system.horizon, LONGEST_RUN)


def visited_points(system: System, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return all states of :func:`reachable_points` within the limit, (n, d), and inputs, (n, m).

    Runs with the same first input share their first states, which are then there several times.
    """
    inputs = np.stack(_held(system, rng) + _waves(system), axis=1)
    inputs = np.clip(inputs, -system.cut_at, system.cut_at)
    visited = simulate(system, inputs).reshape(-1, system.n_states)
    applied = np.concatenate([inputs, np.zeros_like(inputs[:1])]).reshape(-1, system.n_inputs)
    inside = np.all(np.abs(visited) <= system.state_limit, axis=1)
    return visited[inside], applied[inside]


def simulate(
    system: System,
    inputs: Array,
    start: Array | None = None,
    accelerations: Callable[[Array, Array], Array] | None = None,
) -> Array:
    """Return the noise-free states, (T + 1, n, d), under inputs (T, n, m).

    They start at the initial state, or at states (n, d), and follow the true accelerations of each
    step, or others (:func:`rates`). States that overflow become infinite or NaN, and stay so.
    """
    steps, n, _ = inputs.shape
    states = np.empty((steps + 1, n, system.n_states))
    states[0] = system.initial_state if start is None else start
    with np.errstate(over="ignore", invalid="ignore"):
        for t in range(steps):
            there = accelerations or functools.partial(_learned, system, t)
            rate = functools.partial(rates, system, there, inputs[t])
            states[t + 1] = next_state(system.integrator, rate, states[t], system.dt)
    return states


def _learned(system: System, step: int, states: Array, inputs: Array) -> Array:
    return system.learned(states, step, inputs)


def rates(
    system: System, accelerations: Callable[[Array, Array], Array], inputs: Array, states: Array
) -> Array:
    """Return dx/dt, (N, d), of states (N, d) under inputs (N, m), with accelerations (N, r)."""
    flow = system.known_flow(states, inputs)
    flow[:, list(system.learned_rows)] += accelerations(states, inputs)
    return flow


def _held(system: System, rng: np.random.Generator) -> list[Array]:
    """Return random inputs on the sphere, held for several spans: each (T, m)."""
    sequences, steps = [], run_steps(system)
    for hold in HELD_STEPS:
        draws = rng.standard_normal((-(-steps // hold), system.n_inputs))
        held = np.repeat(on_sphere(draws, system.gamma), hold, axis=0)
        sequences.append(held[:steps])
    return sequences


def _waves(system: System) -> list[Array]:
    """Return square waves about the eigenfrequency and one of rising frequency: each (T, m).

    A system without a mode is excited at ten periods in a run, along the first input.
    """
    mode, steps = eigenmode(system), run_steps(system)
    duration = system.dt * steps
    frequency = mode.frequency if mode else 20.0 * math.pi / duration
    direction = mode.direction if mode else np.eye(system.n_inputs)[0]
    times = system.dt * np.arange(steps)
    low, high = (ratio * frequency for ratio in CHIRP_RANGE)
    phases = [ratio * frequency * times for ratio in FREQUENCY_RATIOS]
    phases.append(low * times + 0.5 * (high - low) / duration * times**2)
    return [system.gamma * np.sign(np.sin(p))[:, None] * direction for p in phases]


DRAWN = 4096
"""States of the box among which a task's are chosen."""

_TASK_SEED = 20_260_101


@functools.lru_cache(maxsize=64)
def task_states(system: System, task: TaskOptimal) -> Array:
    """Return states, (≤ count, d), drawn without replacement by their weights; always the same."""
    rng = np.random.default_rng(_TASK_SEED)
    states = reachable_states(system) if task.states == "reachable" else _box(system, rng)
    weights = goal_weights(system, task, states)
    count = min(task.count, int(np.count_nonzero(weights)))
    chosen = rng.choice(len(states), count, replace=False, p=weights / weights.sum())
    return np.ascontiguousarray(states[np.sort(chosen)])


@functools.lru_cache(maxsize=64)
def box_states(system: System) -> Array:
    """Return states, (4096, d), uniform in the evaluation box; always the same."""
    return _box(system, np.random.default_rng(_TASK_SEED))


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
