"""Model-predictive control with a learned model, and predictions over many steps."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dopt.control.task import Control, Feedback, Goal
from dopt.evaluation import evaluation_set, simulate
from dopt.policies.base import on_sphere
from dopt.systems.base import System
from dopt.types import Array

# Prediction of many states over many steps, with true or modelled accelerations.


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
    return simulate(system, inputs.swapaxes(0, 1), states, accelerations)[1:]


# Cross-entropy planner: sample input sequences, keep the best, sample around them.


Objective = Callable[[Array], Array]
"""Costs (N,) of input sequences (N, H, m); one that is not finite counts as the worst."""


def cross_entropy(
    objective: Objective,
    start: Array,
    rng: np.random.Generator,
    *,
    gamma: float,
    samples: int,
    iterations: int,
    elites: int,
) -> Array:
    """Return the best sequence that was tried, (H, m); ``start`` (H, m) is the first.

    Every round tries the mean of the elites of the one before as it is, and the last mean is
    tried as well. The first round is as wide as the ball of inputs, each component with
    standard deviation γ/√m.

    Parameters
    ----------
    gamma : float
        Bound γ of the norm of an input.
    samples, iterations, elites : int
        Sequences in a round, rounds, and sequences that the next round is sampled around.
    """
    best, lowest = start, np.inf
    mean, deviation = start, np.full(start.shape, gamma / np.sqrt(start.shape[1]))
    for _ in range(iterations):
        draws = rng.standard_normal((samples, *start.shape))
        draws[0] = 0.0
        U = within_ball(mean + deviation * draws, gamma)
        J = _costs(objective, U)
        chosen = U[np.argsort(J, kind="stable")[:elites]]
        if J.min() < lowest:
            best, lowest = chosen[0], J.min()
        mean, deviation = chosen.mean(axis=0), chosen.std(axis=0)
    return mean if _costs(objective, mean[None])[0] < lowest else best


def _costs(objective: Objective, inputs: Array) -> Array:
    J = objective(inputs)
    return np.where(np.isfinite(J), J, np.inf)


def within_ball(inputs: Array, radius: float) -> Array:
    """Return inputs, (..., m), those outside the ball of a radius moved onto it."""
    norms = np.linalg.norm(inputs, axis=-1, keepdims=True)
    shrunk: Array = inputs * np.minimum(1.0, radius / np.maximum(norms, 1e-300))
    return shrunk


# Control episodes, by model-predictive control or feedback, on the true system with its noise.


@dataclass(frozen=True)
class Episode:
    """States, inputs and cost of one control episode.

    Attributes
    ----------
    states : (steps + 1, d)
    inputs : (steps, m)
    cost : float
        Sum over the steps; infinite or NaN where the plant left the system's limit.
    success : bool
        Whether the last states are at the goal.
    """

    states: Array
    inputs: Array
    cost: float
    success: bool


def run_episode(
    system: System,
    task: Control,
    plant: Forecast,
    forecast: Forecast,
    noise: Array,
    rng: np.random.Generator,
) -> Episode:
    """Control the true system by model-predictive control with a model.

    Every ``hold`` steps the planner looks ``hold * lookahead`` steps ahead from the state that it
    observes; the first input of the plan is held, the others start the next plan.

    Parameters
    ----------
    plant
        Of the true system.
    forecast
        Prediction that the planner uses, by a model or by the true system.
    noise : (steps, d)
        w_t of the plant.
    rng
        Draws of the planner.
    """
    goal = task.on(system)
    sizes = {"samples": task.samples, "iterations": task.iterations, "elites": task.elites}
    plan = np.zeros((goal.lookahead, system.n_inputs))
    states = np.empty((goal.steps + 1, system.n_states))
    states[0] = goal.initial_state
    inputs = np.empty((goal.steps, system.n_inputs))
    for t in range(goal.steps):
        if t % goal.hold == 0:
            if t:
                plan = np.concatenate([plan[1:], np.zeros_like(plan[:1])])
            ahead = _objective(system, goal, forecast, states[t])
            plan = cross_entropy(ahead, plan, rng, gamma=system.gamma, **sizes)
        inputs[t] = plan[0]
        states[t + 1] = plant(states[t : t + 1], plan[None, :1])[0, 0] + noise[t]
    return _judged(system, goal, states, inputs)


def run_feedback(
    system: System, goal: Goal, plant: Forecast, feedback: Feedback, noise: Array
) -> Episode:
    """Control the true system by a law of feedback.

    Parameters
    ----------
    plant
        Of the true system.
    noise : (steps, d)
        w_t of the plant.
    """
    states = np.empty((goal.steps + 1, system.n_states))
    states[0] = goal.initial_state
    inputs = np.empty((goal.steps, system.n_inputs))
    for t in range(goal.steps):
        inputs[t] = feedback(states[t]) if t % feedback.hold == 0 else inputs[t - 1]
        states[t + 1] = plant(states[t : t + 1], inputs[None, t : t + 1])[0, 0] + noise[t]
    return _judged(system, goal, states, inputs)


def _judged(system: System, goal: Goal, states: Array, inputs: Array) -> Episode:
    cost = float(np.sum(costs(system, goal, states[1:], inputs)))
    if not np.all(np.abs(states) <= system.state_limit):
        return Episode(states, inputs, math.inf, success=False)
    return Episode(states, inputs, cost, succeeds(system, goal, states))


def _objective(system: System, goal: Goal, forecast: Forecast, state: Array) -> Objective:
    def objective(plans: Array) -> Array:
        inputs = np.repeat(plans, goal.hold, axis=1)
        states = forecast(np.tile(state, (len(plans), 1)), inputs)
        with np.errstate(over="ignore", invalid="ignore"):
            total: Array = costs(system, goal, states, inputs.swapaxes(0, 1)).sum(axis=0)
        return total

    return objective


def costs(system: System, goal: Goal, states: Array, inputs: Array) -> Array:
    """Return the cost, (...), of being in states (..., d) after inputs (..., m)."""
    errors = states - np.array(goal.goal)
    angles = list(system.angle_indices)
    squares = errors**2
    squares[..., angles] = 2.0 - 2.0 * np.cos(errors[..., angles])
    total: Array = squares @ np.array(goal.state_weights)
    total += goal.input_weight * np.sum(inputs**2, axis=-1)
    return total


def succeeds(system: System, goal: Goal, states: Array) -> bool:
    """Return True if the last ``settle_steps`` of states (n, d) are at the goal."""
    errors = states[-goal.settle_steps :] - np.array(goal.goal)
    angles = list(system.angle_indices)
    errors[:, angles] = np.angle(np.exp(1j * errors[:, angles]))
    tolerances = np.array(goal.tolerances)
    asked = tolerances > 0.0
    return bool(np.all(np.abs(errors[:, asked]) <= tolerances[asked]))


# Free-run error: the error of a model that predicts many steps without measurements.


STARTS = 256
"""Held-out states from which the predictions start, at most."""

HOLD_STEPS = 10
"""Steps for which a held-out input is held."""

_SEED = 20_230_201


@dataclass(frozen=True)
class HeldOut:
    """True trajectories that no trial learns from.

    Attributes
    ----------
    starts : (N, d)
        States of the reachable set (:func:`dopt.evaluation.reachable_states`).
    inputs : (N, n, m)
        Random inputs on the sphere ‖u‖ = γ, held for 10 steps.
    states : (n, N, d)
        True states after each step, without noise.
    """

    starts: Array
    inputs: Array
    states: Array


@functools.lru_cache(maxsize=16)
def held_out(system: System, steps: int) -> HeldOut:
    """Return the trajectories of n steps; a function of the system's parameters alone."""
    points = evaluation_set(system)
    reachable = points.states[points.n_grid :]  # in the order of time
    starts = reachable[:: -(-len(reachable) // STARTS)]
    rng = np.random.default_rng(_SEED)
    draws = rng.standard_normal((len(starts), -(-steps // HOLD_STEPS), system.n_inputs))
    inputs = np.repeat(on_sphere(draws, system.gamma), HOLD_STEPS, axis=1)[:, :steps]
    return HeldOut(starts, inputs, forecast_by_equations(system)(starts, inputs))


def free_run_error(system: System, forecast: Forecast, steps: int) -> float:
    """Return the relative root mean square error of predictions over 1 ... n steps.

    The squared error of each state component is divided by the mean square of its true change
    since the start, and the mean over the components is taken: 1 is the error of the prediction
    that nothing changes, 0 the error of the true model. No unit. Infinite or NaN where the model's
    prediction overflows.
    """
    truth = held_out(system, steps)
    return relative_error(forecast(truth.starts, truth.inputs), truth.states, truth.starts)


def relative_error(predicted: Array, states: Array, starts: Array) -> float:
    """Return the error of predictions (H, N, d) of states (H, N, d), in units of their changes.

    The changes are those from the starts, (N, d); a component that never changes does not count.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.mean((predicted - states) ** 2, axis=(0, 1))
    changes = np.mean((states - starts) ** 2, axis=(0, 1))
    moved = changes > 0.0
    return float(np.sqrt(np.mean(errors[moved] / changes[moved])))
