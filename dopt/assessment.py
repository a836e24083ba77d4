"""Assessment of a trial: control, free runs, coverage, parameters, violated limits, samples."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from dopt.control.planning import (
    Forecast,
    forecast_by,
    forecast_by_equations,
    free_run_error,
    run_episode,
    run_feedback,
)
from dopt.control.task import Control, Feedback
from dopt.errors import SpecificationError
from dopt.evaluation import evaluation_set
from dopt.limits import VIOLATIONS, WORST
from dopt.models import MLP, Linear, Model
from dopt.offline_fit import sample_loss
from dopt.randomness import stream
from dopt.result import Assessment, TrialResult
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.types import Array


def true_forecast(system: System) -> Forecast:
    """Return the forecast by the system itself as it is at the first step, without noise."""
    if not system.compiled:
        return forecast_by_equations(system)
    from dopt.kernel import run

    return run.true_forecast(system)


def model_forecast(system: System, model: Model, parameters: Array) -> Forecast:
    """Return the forecast by a model with parameters (q,) in place of the true accelerations.

    Forecasts by networks and by the linear form of physics run in compiled code.
    """
    if not (system.compiled and model.compiled and isinstance(model, (MLP, Linear))):
        return forecast_by(
            system, lambda x, u: model.predict_at(system, parameters, model.points(system, x, u))
        )
    from dopt.kernel import run

    return run.model_forecast(system, model, parameters)


TURN = 2 * math.pi

CELLS = 20
"""Cells along each side of the box."""

Box = tuple[tuple[float, float], tuple[float, float]]


def wrap(angle: Array, centre: float = 0.0) -> Array:
    """Return angles moved by whole turns into [centre - π, centre + π)."""
    return angle - TURN * turns(angle, centre)


def turns(angle: Array, centre: float = 0.0) -> Array:
    """Return the number of whole turns between each angle and its wrapped value."""
    return np.floor((angle - centre + math.pi) / TURN)


@dataclass(frozen=True)
class Plane:
    """Phase plane of a system: state indices, labels, axes that are angles, box.

    Angles are centred on the stable equilibrium, so that small oscillations about it are not split
    at the wrap. A box that covers the whole turn moves with them.
    Where the evaluation grid has no such axis, the box is the whole turn of an angle, and otherwise
    what the reachable set spans.
    """

    axes: tuple[int, int]
    labels: tuple[str, str]
    angles: tuple[bool, bool]
    centres: tuple[float, float]
    box: Box

    @classmethod
    def of(cls, system: System) -> Self:
        """Return the phase plane of a system."""
        first, second = axes = system.phase_plane
        rest = system.equilibrium or (0.0,) * system.n_states
        angles = first in system.angle_indices, second in system.angle_indices
        centres = rest[first] if angles[0] else 0.0, rest[second] if angles[1] else 0.0
        sides = [_given_side(system, axis) for axis in axes]
        for i in np.flatnonzero(angles):
            sides[i] = _side(sides[i], centres[i])
        labels = system.state_labels[first], system.state_labels[second]
        return cls(axes, labels, angles, centres, (sides[0], sides[1]))

    def project(self, states: Array) -> Array:
        """Return the points (n, 2) of states (n, d), angles not wrapped."""
        return states[:, list(self.axes)]

    def wrapped(self, points: Array) -> Array:
        """Return points (n, 2) with angles inside one turn around the centre."""
        inside = points.copy()
        for axis in np.flatnonzero(self.angles):
            inside[:, axis] = wrap(points[:, axis], self.centres[axis])
        return inside

    def coverage(self, states: Array) -> float:
        """Return the share of the box that states (n, d) visit."""
        return coverage(self.wrapped(self.project(states)), self.box)


def _given_side(system: System, axis: int) -> tuple[float, float]:
    """Return the ends of the box along a component of the state."""
    given = system.grid_box()
    if axis in given:
        return given[axis]
    if axis in system.angle_indices:
        return -math.pi, math.pi
    points = evaluation_set(system)
    reached = points.states[points.n_grid :, axis]
    return float(reached.min()), float(reached.max())


def _side(side: tuple[float, float], centre: float) -> tuple[float, float]:
    low, high = side
    if high - low > TURN - 1e-9:
        return centre - np.pi, centre + np.pi
    shift = float(wrap(np.array((low + high) / 2), centre)) - (low + high) / 2
    return low + shift, high + shift


def coverage(points: Array, box: Box, cells: int = CELLS) -> float:
    """Return the share of the cells² equal cells of a box that hold at least one of (n, 2) points.

    Angles are to be wrapped beforehand; points outside the box and NaN count nowhere.
    """
    counts, _, _ = np.histogram2d(
        points[:, 0], points[:, 1], bins=cells, range=[list(side) for side in box]
    )
    return float(np.mean(counts > 0))


def true_parameters(system: System, step: int = 0, names: Sequence[str] = ()) -> Array:
    """Return the true values, (q,), of physical parameters at a step, in their units.

    Without ``names`` they are the system's ``linear_parameters``.

    Raises
    ------
    SpecificationError
        If it has none: its learned accelerations are not linear in unknown parameters.
    """
    if not (names or system.linear_parameters):
        raise SpecificationError(
            f"env '{system.name}' has no parameters that its accelerations are linear in, but a "
            f"parameter error needs some: choose another env."
        )
    row = system.history[min(step, len(system.history) - 1)]
    values = dict(zip(system.physical, row, strict=True))
    return np.array([values[name] for name in names or system.linear_parameters])


def parameter_error(
    system: System, parameters: npt.ArrayLike, step: int = 0, names: Sequence[str] = ()
) -> float:
    """Return ‖θ - θ*‖₂ for learned parameters θ, (q,), with θ* true at a step.

    They are the named parameters, or by default the linear model's.
    """
    return float(np.linalg.norm(np.asarray(parameters) - true_parameters(system, step, names)))


KEPT_OUTCOMES = 4096
"""Outcomes that trials of one seed share and that are kept: the true and the untrained model's."""

SAMPLE_LOSS = "sample_loss"

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
    WORST: "farthest distance beyond a bound up to t, in the unit of the state; 0 within bounds",
    SAMPLE_LOSS: "loss of a Gaussian process tuned by its evidence on the trial's own samples",
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
        if feedbacks and t in feedbacks:  # with the noise of the other episodes
            goal, noise = task.on(spec.system), _control_noise(spec.system, task, spec.seed)
            truth = true_forecast(spec.system)
            episode = run_feedback(spec.system, goal, truth, feedbacks[t], noise)
            rows += _measured(t, "feedback", (episode.success, episode.cost))
        error = free_run_error(spec.system, forecast, task.free_run_steps)
        rows.append(Assessment(t, "free_run_error", error))
        rows.append(Assessment(t, "coverage", plane.coverage(states[: t + 1])))
    return tuple(rows)


Outcome = tuple[bool, float]
"""Success and cost of an episode."""


def _controlled(system: System, task: Control, seed: int, forecast: Forecast) -> Outcome:
    """Run an episode; all of a seed share the noise and the planner's draws."""
    noise, plans = _control_noise(system, task, seed), stream(seed, "control_plans")
    episode = run_episode(system, task, true_forecast(system), forecast, noise, plans)
    return episode.success, episode.cost


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
    success, cost = outcome
    yield Assessment(t, f"{name}_success", float(success))
    yield Assessment(t, f"{name}_cost", cost)


def assessed(spec: TrialSpec, result: TrialResult) -> TrialResult:
    """Return the result with its assessments, where the trial asks for them."""
    rows: tuple[Assessment, ...] = ()
    if spec.task is not None:
        rows += assess(spec, spec.task, result.checkpoints, result.states, result.feedbacks)
    if spec.limits is not None:
        reached = result.states[1:]
        finite = np.isfinite(reached).all(axis=1)
        rows += violations(spec.limits.excess(spec.system, reached[finite]))
    if spec.config.sample_loss and not result.diverged:
        loss = sample_loss(spec, result.states, result.inputs)
        rows += (Assessment(result.n_steps, SAMPLE_LOSS, loss),)
    return dataclasses.replace(result, assessments=rows) if rows else result


def violations(excess: Array) -> tuple[Assessment, ...]:
    """Return the measures of limits after t steps, whose states are so far beyond bounds, (t,)."""
    t = len(excess)
    return (
        Assessment(t, VIOLATIONS, float(np.count_nonzero(excess))),
        Assessment(t, WORST, float(excess.max(initial=0.0))),
    )
