"""Inputs that keep the states of a plant within bounds, in compiled code (:mod:`dopt.limits`).

An input is accepted if after it some backup input keeps the predicted states within the bounds,
also where the predicted accelerations, or an estimated state, are off by the margin. Otherwise the
first of a few other inputs for which that holds takes its place, or the one that leads least far
beyond the bounds.
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import TIE_MARGIN
from dopt.kernel.compiler import compiled
from dopt.kernel.integration import add_stage, n_stages, predicted_state, write_rate
from dopt.kernel.joint_kalman import acceleration_variances, state_variances
from dopt.kernel.learners import sampled_point
from dopt.kernel.model import model_accelerations, model_point
from dopt.kernel.sensors import has_sensors
from dopt.kernel.structs import Limits, Trial
from dopt.types import Matrix, Vector

NEWEST_ERRORS = 25
"""Samples over which limits take the exponential mean of the model's squared error."""


@compiled
def limit_input(trial: Trial, t: int, u: Vector) -> None:
    """Replace u_t by an input that is within the limits; one that is not finite stays."""
    limits, record = trial.limits, trial.record
    if not np.isfinite(u).all():
        return
    before, x = input_before(trial), record.states[t]
    move_within(limits, before, u)
    if limits.steps > 0:
        keep_within_bounds(trial, t, x, before, u)
    trial.state.prediction.last_input[:] = u


@compiled
def input_before(trial: Trial) -> Vector:
    """Return the last input, (m,), moved into its box and the sphere ‖u‖ ≤ γ.

    It is what was planned last, or what was applied in its place.
    """
    limits, before, norm = trial.limits, trial.state.prediction.last_input.copy(), 0.0
    for j in range(before.shape[0]):
        before[j] = min(max(before[j], limits.input_lower[j]), limits.input_upper[j])
        norm += before[j] * before[j]
    norm = np.sqrt(norm)
    if norm > trial.plant.gamma:
        before *= trial.plant.gamma / norm
    return before


@compiled
def keep_within_bounds(trial: Trial, t: int, x: Vector, before: Vector, u: Vector) -> None:
    """Replace an input that leads beyond the bounds of the states."""
    limits = trial.limits
    backups = backup_inputs(trial.plant.gamma, u.shape[0])
    estimated = has_sensors(trial.sensors)
    errors = estimate_bounds(trial, t, x) if estimated else error_bounds(trial, x)
    others = np.concatenate((u.reshape(1, -1), -u.reshape(1, -1), backups))
    chosen, best = u.copy(), np.inf
    for i in range(others.shape[0]):
        tried = others[i]
        move_within(limits, before, tried)
        excess = largest_excess(trial, x, tried, backups, errors, best)
        if excess < best * (1.0 - TIE_MARGIN):
            best = excess
            chosen[:] = tried
        if best <= 0.0:
            break
    u[:] = chosen


@compiled
def move_within(limits: Limits, before: Vector, u: Vector) -> None:
    """Move an input, (m,), into its box, and then towards the one before it to heed the rates."""
    share = 1.0
    for j in range(u.shape[0]):
        u[j] = min(max(u[j], limits.input_lower[j]), limits.input_upper[j])
        change = abs(u[j] - before[j])
        if change > limits.input_change[j]:
            share = min(share, limits.input_change[j] / change)
    if share < 1.0:
        for j in range(u.shape[0]):
            u[j] = before[j] + share * (u[j] - before[j])


@compiled
def backup_inputs(gamma: float, m: int) -> Matrix:
    """Return ±γ along each axis and 0, (2 m + 1, m), by which a plant may be kept within bounds."""
    inputs = np.zeros((2 * m + 1, m))
    for j in range(m):
        inputs[2 * j, j] = gamma
        inputs[2 * j + 1, j] = -gamma
    return inputs


@compiled
def error_bounds(trial: Trial, x: Vector) -> Vector:
    """Return the largest errors of predicted accelerations that are reckoned with, (r,).

    Each acceleration is taken to be off alone, by the margin times √(s² (1 + h)): h = g M⁻¹ gᵀ at
    the predicted state is the model's own uncertainty, 0 where no M is held or a search plans by
    it, and s² is what it has proved to be worth so far.
    """
    plant, state, network = trial.plant, trial.state, trial.network
    error, r = state.prediction, plant.learned_rows.shape[0]
    bar = predicted_state(plant, network, state.theta, x)
    point = model_point(network, bar, np.zeros(plant.n_inputs))
    columns = np.zeros((plant.n_inputs, point.shape[0]))
    bounds = np.empty(r)
    for k in range(r):
        forms = trial.information.planning_forms(plant, network, state, point, columns, k)
        h = forms[0, 0]
        error.variances[0, k] = error.variances[1, k]
        error.variances[1, k] = h if h > 0.0 else 0.0
        bounds[k] = trial.limits.margin * np.sqrt(error.scale[k] * (1.0 + error.variances[1, k]))
    return bounds


@compiled
def estimate_bounds(trial: Trial, t: int, x: Vector) -> Vector:
    """Return the largest errors of accelerations and of the estimate x, (r + d,), at step t.

    Each is taken to be off alone, by the margin times the standard deviation that the filter over
    state and parameters has for it.
    """
    plant, theta = trial.plant, trial.state.theta
    bar = predicted_state(plant, trial.network, theta, x)
    of_accelerations = acceleration_variances(trial, bar)
    of_states = state_variances(trial, t)
    variances = np.concatenate((of_accelerations, of_states))
    for i in range(variances.shape[0]):  # rounding may leave one below 0
        variances[i] = variances[i] if variances[i] > 0.0 else 0.0
    bounds: Vector = trial.limits.margin * np.sqrt(variances)
    return bounds


@compiled
def note_error(trial: Trial, t: int, target: Vector) -> None:
    """Take the error of the accelerations observed at step t, (r,), before they are learned.

    Estimated states need no such bound: the filter knows how uncertain they are.
    """
    error, value = trial.state.prediction, np.empty(target.shape[0])
    error.last_input[:] = trial.record.inputs[t]
    if has_sensors(trial.sensors):
        return
    point = sampled_point(trial, t)
    model_accelerations(trial.plant, trial.network, trial.state.theta, point, value)
    share = max(1.0 / (t + 1.0), 1.0 / NEWEST_ERRORS)
    for k in range(target.shape[0]):
        square = (target[k] - value[k]) ** 2 / (1.0 + error.variances[0, k])
        error.scale[k] += share * (square - error.scale[k])


@compiled
def largest_excess(
    trial: Trial, x: Vector, u: Vector, backups: Matrix, errors: Vector, best: float
) -> float:
    """Return how far beyond the bounds an input leads, at most 0 if not at all.

    It is the largest over the errors of the prediction, none or one of ±``errors``, of the smallest
    over the backup inputs. It may stop at ``best``. The errors are of accelerations, (r,), with
    followed by the bounds of an estimated state, (r + d,).
    """
    largest, kept = -np.inf, 0  # the backup input that has kept the states within bounds
    for case in range(1 + 2 * errors.shape[0]):
        smallest = np.inf
        for i in range(backups.shape[0]):
            backup = (kept + i) % backups.shape[0]
            excess = path_excess(trial, x, u, backups[backup], errors, case, smallest)
            smallest = min(smallest, excess)
            if smallest <= 0.0:
                kept = backup
                break
        largest = max(largest, smallest)
        if largest >= best:
            break
    return largest


@compiled
def path_excess(
    trial: Trial, x: Vector, first: Vector, backup: Vector, errors: Vector, case: int, stop: float
) -> float:
    """Return the largest excess on the path of an input and a backup input that is held after it.

    It is in the units of the states, or ``stop`` or more where it is no less than that.
    """
    plant, limits, network = trial.plant, trial.limits, trial.network
    d, r = x.shape[0], plant.learned_rows.shape[0]
    state, following, rate, total = x.copy(), np.empty(d), np.empty(d), np.empty(d)
    accelerations, u, target = np.empty(r), first.copy(), np.empty(first.shape[0])
    largest, k, off = -np.inf, (case - 1) // 2, 0.0
    if case > 0:
        off = errors[k] if case % 2 == 1 else -errors[k]
    if k >= r:
        state[k - r] += off
    for step in range(limits.steps):
        if step > 0:
            target[:] = backup
            move_within(limits, u, target)
            u[:] = target
        following[:] = state
        for stage in range(n_stages(plant)):
            point = model_point(network, following, u)
            model_accelerations(plant, network, trial.state.theta, point, accelerations)
            if 0 <= k < r:
                accelerations[k] += off
            write_rate(plant, following, u, accelerations, rate)
            add_stage(plant, stage, plant.dt, state, rate, total, following)
        for i in range(d):
            if not np.isfinite(following[i]):
                return np.inf
            excess = max(limits.lower[i] - following[i], following[i] - limits.upper[i])
            largest = max(largest, excess)
        if largest >= stop:
            return largest
        state[:] = following
    return largest
