"""Assessment of a trial: control, free-run error and coverage after some of its steps."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dopt.control.planning import Forecast, free_run_error, run_episode, run_feedback
from dopt.control.task import Control, Feedback
from dopt.coverage import Plane
from dopt.forecasts import model_forecast, true_forecast
from dopt.limits import VIOLATIONS, WORST
from dopt.models.base import Model
from dopt.randomness import stream
from dopt.result import Assessment, TrialResult
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System

Array = npt.NDArray[np.float64]

KEPT_OUTCOMES = 4096
"""Outcomes that trials of one seed share and that are kept: the true and the untrained model's."""

MEASURES = {
    "control_success": "1 if the episode that the learned model plans succeeds, otherwise 0",
    "control_cost": "its cost",
    "feedback_success": "1 if the episode succeeds that the policy's own feedback controls, or 0",
    "feedback_cost": "its cost",
    "true_model_success": "the same with the true model under the same planner, at t = 0",
    "true_model_cost": "its cost, at t = 0",
    "free_run_error": "relative root mean square error of predictions over n steps",
    "coverage": "share of the phase plane's box that the states up to t have visited",
    VIOLATIONS: "number of states up to t that are beyond a bound of the limits",
    WORST: "farthest distance beyond a bound up to t, in the unit of the state; 0 if there is none",
}
"""Every measure with its meaning; t is the number of steps explored, 0 the untrained model."""


def assess(
    spec: TrialSpec,
    task: Control,
    parameters: Mapping[int, Array],
    states: Array,
    feedbacks: Mapping[int, Feedback] | None = None,
) -> tuple[Assessment, ...]:
    """Return the measures of a trial.

    Parameters
    ----------
    parameters
        Parameters (q,) of the model after each number of steps that is to be assessed.
    states : (T + 1, d)
        States of the trial.
    feedbacks
        Laws of feedback that the policy has learned, after the same numbers of steps.
    """
    rows: list[Assessment] = []
    if parameters:
        rows += _measured(0, "true_model", _with_the_truth(spec.system, task, spec.seed))
    plane = Plane.of(spec.system)
    for t, theta in sorted(parameters.items()):
        forecast = model_forecast(spec.system, spec.model, theta)
        if t == 0 and np.array_equal(theta, _initial(spec.system, spec.model, spec.seed)):
            outcome = _untrained(spec.system, spec.model, task, spec.seed)
        else:
            outcome = _controlled(spec.system, task, spec.seed, forecast)
        rows += _measured(t, "control", outcome)
        if feedbacks and t in feedbacks:
            rows += _measured(t, "feedback", _fed_back(spec.system, task, spec.seed, feedbacks[t]))
        error = free_run_error(spec.system, forecast, task.free_run_steps)
        rows.append(Assessment(t, "free_run_error", error))
        rows.append(Assessment(t, "coverage", plane.coverage(states[: t + 1])))
    return tuple(rows)


class Outcome(NamedTuple):
    """Success and cost of an episode."""

    success: bool
    cost: float


def _controlled(system: System, task: Control, seed: int, forecast: Forecast) -> Outcome:
    """Run an episode; all of a seed share the noise and the planner's draws."""
    noise, plans = _control_noise(system, task, seed), stream(seed, "control_plans")
    episode = run_episode(system, task, true_forecast(system), forecast, noise, plans)
    return Outcome(episode.success, episode.cost)


def _fed_back(system: System, task: Control, seed: int, feedback: Feedback) -> Outcome:
    """Run an episode under a law of feedback, with the noise of the other episodes of its seed."""
    noise = _control_noise(system, task, seed)
    episode = run_feedback(system, task.on(system), true_forecast(system), feedback, noise)
    return Outcome(episode.success, episode.cost)


def _control_noise(system: System, task: Control, seed: int) -> Array:
    """Return w_t of an episode, (steps, d)."""
    steps = task.on(system).steps
    noise = stream(seed, "control_noise").standard_normal((steps, system.n_states))
    scaled: Array = np.sqrt(system.dt) * system.noise * noise
    return scaled


@functools.lru_cache(maxsize=KEPT_OUTCOMES)
def _with_the_truth(system: System, task: Control, seed: int) -> Outcome:
    return _controlled(system, task, seed, true_forecast(system))


@functools.lru_cache(maxsize=KEPT_OUTCOMES)
def _untrained(system: System, model: Model, task: Control, seed: int) -> Outcome:
    forecast = model_forecast(system, model, _initial(system, model, seed))
    return _controlled(system, task, seed, forecast)


def _initial(system: System, model: Model, seed: int) -> Array:
    return model.initial_parameters(system, stream(seed, "weights"))


def _measured(t: int, name: str, outcome: Outcome) -> Iterator[Assessment]:
    yield Assessment(t, f"{name}_success", float(outcome.success))
    yield Assessment(t, f"{name}_cost", outcome.cost)


def assessed(spec: TrialSpec, result: TrialResult) -> TrialResult:
    """Return the result with its assessments, where the trial asks for them."""
    rows: tuple[Assessment, ...] = ()
    if spec.task is not None:
        rows += assess(spec, spec.task, result.checkpoints, result.states, result.feedbacks)
    if spec.limits is not None:
        reached = result.states[1:]
        finite = np.isfinite(reached).all(axis=1)
        rows += violations(spec.limits.excess(spec.system, reached[finite]))
    return dataclasses.replace(result, assessments=rows) if rows else result


def violations(excess: Array) -> tuple[Assessment, ...]:
    """Return the measures of limits after t steps, whose states are so far beyond bounds, (t,)."""
    t = len(excess)
    return (
        Assessment(t, VIOLATIONS, float(np.count_nonzero(excess))),
        Assessment(t, WORST, float(excess.max(initial=0.0))),
    )
