"""Algorithm 1 in compiled code: plan, act, observe, learn, update M, evaluate.

:func:`plan_input` and :func:`take_in` are the steps that an exploration of a plant
(:class:`dopt.explorer.Explorer`) consists of; a trial puts between them the simulated system.
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import Integrator, ModelKind
from dopt.kernel.checks import within
from dopt.kernel.compiler import called_from_python, compiled, monotonic_microseconds
from dopt.kernel.evaluation import add_sample, evaluation_buffers, follow_truth, model_error
from dopt.kernel.integration import next_model_state, next_true_state
from dopt.kernel.learners.samples import sampled_point
from dopt.kernel.limits import limit_input, note_error
from dopt.kernel.members import learn_members, members_or_one
from dopt.kernel.model import model_accelerations
from dopt.kernel.points import model_point, sampled_state
from dopt.kernel.sensors import (
    estimate_state,
    has_sensors,
    measure,
    output_error,
)
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
    if trial.limits.enforced:
        limit_input(trial, t, u)
    trial.record.plan_us[t] = monotonic_microseconds() - start


@compiled
def act(plant: Plant, x: Vector, u: Vector, noise: Vector, t: int, following: Vector) -> None:
    """Write x_{t+1} (equation 2) of the simulated system."""
    parameters = plant.history[min(t, plant.history.shape[0] - 1)]
    next_true_state(plant, parameters, x, u, following)
    for i in range(x.shape[0]):
        following[i] += noise[i]


@compiled
def observe(trial: Trial, t: int, dt: float, target: Vector) -> None:
    """Write the accelerations observed from x_t to x_{t+1}, (r,), after dt seconds.

    With the integrator of Runge and Kutta they are those in the middle of the step, plus what the
    model's own step differs from the acceleration that it has there: a model whose error at them is
    0 predicts x_{t+1}.
    """
    plant, states = trial.plant, trial.record.states
    u = trial.state.estimate.inputs[t]
    x, following = states[t], states[t + 1]
    at, flow = sampled_state(plant, states, t), np.empty(x.shape[0])
    plant.known(at, u, plant.parameters, flow)
    for k in range(target.shape[0]):
        row = plant.learned_rows[k]
        target[k] = (following[row] - x[row]) / dt - flow[row]
    if plant.integrator == Integrator.EULER:
        return
    network, theta = trial.network, trial.state.theta
    value, end = np.empty(target.shape[0]), np.empty(x.shape[0])
    model_accelerations(plant, network, theta, model_point(network, at, u), value)
    next_model_state(plant, network, theta, x, u, dt, end)
    for k in range(target.shape[0]):
        row = plant.learned_rows[k]
        target[k] -= (end[row] - x[row]) / dt - (flow[row] + value[k])


@compiled
def take_in(trial: Trial, learn: Learn, t: int, dt: float) -> bool:
    """Learn from x_t, u_t and x_{t+1}, dt seconds later, and add the rows at (x_t, u_t) to M.

    Where states are measured with noise, an estimate takes the place of what was measured of
    x_{t+1}. Returns whether the parameters are finite: otherwise nothing is added.
    """
    plant, state, record = trial.plant, trial.state, trial.record
    if has_sensors(trial.sensors):
        estimate_state(trial, t, dt)
    target = np.empty(plant.learned_rows.shape[0])
    observe(trial, t, dt, target)
    if trial.limits.enforced:
        note_error(trial, t, target)
    clock_0 = monotonic_microseconds()
    learn_members(trial, learn, t, target)
    clock_1 = monotonic_microseconds()
    if not within(state.theta, np.inf):
        return False
    trial.information.add_rows(plant, trial.network, state, sampled_point(trial, t))
    record.learn_us[t] = clock_1 - clock_0
    record.plan_us[t] += monotonic_microseconds() - clock_1
    return True


@compiled
def prediction_error(trial: Trial, t: int, dt: float) -> float:
    """Return the error of the model at the accelerations observed from x_t to x_{t+1}.

    Of an ensemble the mean of the members is taken. Where states are measured with noise it is
    :func:`dopt.kernel.sensors.output_error`.
    """
    if has_sensors(trial.sensors):
        return output_error(trial, t, dt)
    plant, thetas, r = trial.plant, members_or_one(trial.state), trial.plant.learned_rows.shape[0]
    target, value, mean = np.empty(r), np.empty(r), np.zeros(r)
    observe(trial, t, dt, target)
    point = sampled_point(trial, t)
    for member in range(thetas.shape[0]):
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
        x, following = record.true_states[t], record.true_states[t + 1]
        plan_input(trial, plan, t)
        act(plant, x, record.inputs[t], trial.randomness.noise[t], t, following)
        if has_sensors(trial.sensors):
            noise = trial.randomness.measurement_noise[t]
            measure(trial.sensors, noise, following, record.states[t + 1])
        if not within(following, plant.state_limit):
            return t
        if not take_in(trial, learn, t, plant.dt):
            return t
        start = monotonic_microseconds()
        if network.kind == ModelKind.GAUSSIAN_PROCESS:
            add_sample(network, points, sampled_state(plant, record.states, t))
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
