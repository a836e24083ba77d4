"""What a trial is worth at some of its steps: the rows of its assessment."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np
import numpy.typing as npt

from dopt.control.episode import run_episode
from dopt.control.free_run import free_run_error
from dopt.control.prediction import Accelerations, modelled
from dopt.control.task import Control
from dopt.coverage import Plane
from dopt.randomness import stream
from dopt.result import Assessment, TrialResult
from dopt.spec import TrialSpec

Array = npt.NDArray[np.float64]

MEASURES = {
    "control_success": "1 if the episode that the learned model plans succeeds, otherwise 0",
    "control_cost": "its cost",
    "true_model_success": "the same with the true model under the same planner, at t = 0",
    "true_model_cost": "its cost, at t = 0",
    "free_run_error": "relative root mean square error of predictions over n steps",
    "coverage": "share of the phase plane's box that the states up to t have visited",
}
"""Every measure with its meaning; t is the number of steps explored, 0 the untrained model."""


def assess(
    spec: TrialSpec, task: Control, parameters: Mapping[int, Array], states: Array
) -> tuple[Assessment, ...]:
    """Return the measures of a trial.

    Parameters
    ----------
    parameters
        Parameters (q,) of the model after each number of steps that is to be assessed.
    states : (T + 1, d)
        States of the trial.
    """
    truth = spec.system.learned
    rows = list(_controlled(spec, task, truth, 0, "true_model")) if parameters else []
    plane = Plane.of(spec.system)
    for t, theta in sorted(parameters.items()):
        model = modelled(spec.system, spec.model, theta)
        error = free_run_error(spec.system, model, task.free_run_steps)
        rows += _controlled(spec, task, model, t, "control")
        rows.append(Assessment(t, "free_run_error", error))
        rows.append(Assessment(t, "coverage", plane.coverage(states[: t + 1])))
    return tuple(rows)


def _controlled(
    spec: TrialSpec, task: Control, accelerations: Accelerations, t: int, name: str
) -> Iterator[Assessment]:
    """Yield success and cost of an episode; all of a trial share the noise and the draws."""
    system, steps = spec.system, task.on(spec.system).steps
    noise = stream(spec.seed, "control_noise").standard_normal((steps, system.n_states))
    noise *= np.sqrt(system.dt) * system.noise
    plans = stream(spec.seed, "control_plans")
    episode = run_episode(system, task, accelerations, noise, plans)
    yield Assessment(t, f"{name}_success", float(episode.success))
    yield Assessment(t, f"{name}_cost", episode.cost)


def assessed(spec: TrialSpec, result: TrialResult) -> TrialResult:
    """Return the result with its assessments, where the trial asks for them."""
    task = spec.task
    if task is None:
        return result
    rows = assess(spec, task, result.checkpoints, result.states)
    return dataclasses.replace(result, assessments=rows)
