"""Algorithm 1 in compiled code: plan, act, observe, learn, update M, evaluate.

:func:`plan_input` and :func:`take_in` are the steps that an exploration of a plant
(:class:`dopt.explorer.Explorer`) consists of; a trial puts between them the simulated system.
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import ModelKind
from dopt.kernel.checks import within
from dopt.kernel.compiler import called_from_python, compiled, monotonic_microseconds
from dopt.kernel.evaluation import add_sample, evaluation_buffers, follow_truth, model_error
from dopt.kernel.limits import limit_input, note_error
from dopt.kernel.members import learn_members, members_or_one
from dopt.kernel.model import model_accelerations
from dopt.kernel.points import model_point, plant_point
from dopt.kernel.structs import Evaluation, Learn, Plan, Plant, Trial
from dopt.types import Vector


@compiled
def plan_input(trial: Trial, plan: Plan, t: int) -> None:
    """Write u_t, the first of which was drawn before the trial, and the time that it took.

    It is what the policy chooses, unless the limits of the trial demand another one.
    """
    start, u = monotonic_microseconds(), trial.record.inputs[t]
    if t > 0:
        plan(trial, t, u)
    else:
        u[:] = trial.randomness.inputs[0]
    limit_input(trial, t, u)
    trial.record.plan_us[t] = monotonic_microseconds() - start


@compiled
def act(plant: Plant, x: Vector, u: Vector, noise: Vector, t: int, following: Vector) -> None:
    """Write x_{t+1} (equation 2) of the simulated system."""
    flow, learned = np.empty(x.shape[0]), np.empty(plant.learned_rows.shape[0])
    plant.known(x, u, plant.parameters, flow)
    parameters = plant.history[min(t, plant.history.shape[0] - 1)]
    plant.accelerations(plant_point(plant, x, u), parameters, learned)
    for k in range(learned.shape[0]):
        flow[plant.learned_rows[k]] += learned[k]
    for i in range(x.shape[0]):
        following[i] = x[i] + plant.dt * flow[i] + noise[i]


@compiled
def observe(
    plant: Plant, x: Vector, u: Vector, following: Vector, dt: float, target: Vector
) -> None:
    """Write the accelerations observed from x_t to x_{t+1}, (r,), after dt seconds."""
    flow = np.empty(x.shape[0])
    plant.known(x, u, plant.parameters, flow)
    for k in range(target.shape[0]):
        row = plant.learned_rows[k]
        target[k] = (following[row] - x[row]) / dt - flow[row]


@compiled
def take_in(trial: Trial, learn: Learn, t: int, dt: float) -> bool:
    """Learn from x_t, u_t and x_{t+1}, dt seconds later, and add the rows at (x_t, u_t) to M.

    Returns whether the parameters are finite: otherwise nothing is added.
    """
    plant, state, record = trial.plant, trial.state, trial.record
    target = np.empty(plant.learned_rows.shape[0])
    observe(plant, record.states[t], record.inputs[t], record.states[t + 1], dt, target)
    note_error(trial, t, target)
    clock_0 = monotonic_microseconds()
    learn_members(trial, learn, t, target)
    clock_1 = monotonic_microseconds()
    if not within(state.theta, np.inf):
        return False
    point = model_point(trial.network, record.states[t], record.inputs[t])
    trial.information.add_rows(plant, trial.network, state, point)
    record.learn_us[t] = clock_1 - clock_0
    record.plan_us[t] += monotonic_microseconds() - clock_1
    return True


@compiled
def prediction_error(trial: Trial, t: int, dt: float) -> float:
    """Return ‖y_t - a_θ(x_t, u_t)‖ of the accelerations observed from x_t to x_{t+1}.

    Of an ensemble the mean of the members is taken.
    """
    plant, record, thetas = trial.plant, trial.record, members_or_one(trial.state)
    x, u, r = record.states[t], record.inputs[t], plant.learned_rows.shape[0]
    target, value, mean = np.empty(r), np.empty(r), np.zeros(r)
    observe(plant, x, u, record.states[t + 1], dt, target)
    for member in range(thetas.shape[0]):
        point = model_point(trial.network, x, u)
        model_accelerations(plant, trial.network, thetas[member], point, value)
        mean += value
    square = 0.0
    for k in range(r):
        error = target[k] - mean[k] / thetas.shape[0]
        square += error * error
    return float(np.sqrt(square))


@called_from_python
def advance(
    trial: Trial, points: Evaluation, plan: Plan, learn: Learn, first: int, last: int
) -> int:
    """Run the steps from ``first`` to ``last`` in place.

    ``plan`` writes the input of a step, of which the first was drawn before the trial; ``learn``
    updates the parameters with the accelerations that were observed in it. Returns the number of
    steps done from the start of the trial: ``last``, or the step at which the trial diverged.
    """
    plant, network, record = trial.plant, trial.network, trial.record
    thetas = members_or_one(trial.state)
    buffers = evaluation_buffers(network, thetas, plant.learned_rows.shape[0])
    for t in range(first, last):
        x, following = record.states[t], record.states[t + 1]
        plan_input(trial, plan, t)
        act(plant, x, record.inputs[t], trial.randomness.noise[t], t, following)
        if not within(following, plant.state_limit):
            return t
        if not take_in(trial, learn, t, plant.dt):
            return t
        start = monotonic_microseconds()
        if network.kind == ModelKind.GAUSSIAN_PROCESS:
            add_sample(network, points, x)
        if plant.history.shape[0] > 1:
            follow_truth(plant, network, points, t)
        loss = model_error(network, thetas, points, 0, points.n_grid, buffers)
        record.loss[t] = loss
        record.reachable_loss[t] = model_error(
            network, thetas, points, points.n_grid, points.n_all, buffers
        )
        record.evaluate_us[t] = monotonic_microseconds() - start
        if not np.isfinite(loss):
            return t
    return last
