"""Control episodes, by model-predictive control or feedback, on the true system with its noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dopt.control.feedback import Feedback
from dopt.control.planner import CrossEntropy, Objective
from dopt.control.prediction import Forecast
from dopt.control.task import Control, Goal
from dopt.systems.base import System

Array = npt.NDArray[np.float64]


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
        Prediction that the planner uses: that of a model, or of the true system.
    noise : (steps, d)
        w_t of the plant.
    rng
        Draws of the planner.
    """
    goal = task.on(system)
    planner = CrossEntropy(system.gamma, task.samples, task.iterations, task.elites)
    plan = np.zeros((goal.lookahead, system.n_inputs))
    states = np.empty((goal.steps + 1, system.n_states))
    states[0] = goal.initial_state
    inputs = np.empty((goal.steps, system.n_inputs))
    for t in range(goal.steps):
        if t % goal.hold == 0:
            if t:
                plan = np.concatenate([plan[1:], np.zeros_like(plan[:1])])
            plan = planner.plan(_objective(system, goal, forecast, states[t]), plan, rng)
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
    """Tell whether the last ``settle_steps`` of states (n, d) are at the goal."""
    errors = states[-goal.settle_steps :] - np.array(goal.goal)
    angles = list(system.angle_indices)
    errors[:, angles] = np.angle(np.exp(1j * errors[:, angles]))
    tolerances = np.array(goal.tolerances)
    asked = tolerances > 0.0
    return bool(np.all(np.abs(errors[:, asked]) <= tolerances[asked]))
