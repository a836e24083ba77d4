"""Algorithm 1 in compiled code: plan, act, observe, learn, update M, evaluate.

An exploration of a plant (:class:`dopt.explorer.Explorer`) consists of :func:`plan_next` and
:func:`take_in_next`; a trial puts between them the simulated system, or a black box that the
interpreter steps (:mod:`dopt.kernel.run`). Where a policy or a learner is written in numpy, the
interpreter calls it between compiled steps, and the model answers its questions with the parameters
of the moment (of an ensemble: of its first member).
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import ModelKind
from dopt.kernel.compiler import called_from_python, compiled, copy_into, monotonic_microseconds
from dopt.kernel.evaluation import Buffers, evaluation_buffers, follow_truth, model_error
from dopt.kernel.gaussian_process import add_to_points
from dopt.kernel.held import HeldTrial, trial_in
from dopt.kernel.integration import input_columns, next_model_state, next_true_state
from dopt.kernel.learners import sampled_point
from dopt.kernel.model import model_accelerations, rows_at, within, write_gradients
from dopt.kernel.sensors import has_sensors, measure, output_error
from dopt.kernel.structs import Evaluation, Learn, Plant, State, Steps, Trial
from dopt.types import Matrix, Stack, Vector


@compiled
def do_nothing(trial: Trial, t: int, row: Vector) -> None:
    """Leave the input, or the parameters, as they are.

    Where no limits are enforced, nothing of the model's errors is remembered.
    """


@compiled
def keep_state(trial: Trial, t: int, dt: float) -> None:
    """Leave x_{t+1} as it is known."""


@compiled
def members_or_one(state: State) -> Matrix:
    """Return the parameters whose mean prediction is evaluated, (E, q), as a view."""
    if state.members.parameters.shape[0] > 0:
        return state.members.parameters
    return state.theta.reshape(1, state.theta.shape[0])


@compiled
def learn_members(trial: Trial, learn: Learn, t: int, target: Vector) -> None:
    """Train the next ensemble member in turn, then member 0, which owns M.

    θ and θ₀ of the state belong to the first member before and after.
    """
    state = trial.state
    members, priors = state.members.parameters, state.members.priors
    if members.shape[0] > 0:
        turn = 1 + t % (members.shape[0] - 1)
        copy_into(members[turn], state.theta)
        copy_into(priors[turn], state.prior)
        learn(trial, t, target)
        copy_into(state.theta, members[turn])
        copy_into(members[0], state.theta)
        copy_into(priors[0], state.prior)
    learn(trial, t, target)
    if members.shape[0] > 0:
        copy_into(state.theta, members[0])


@called_from_python
def plan_next(held: HeldTrial, t: int) -> None:
    """Write u_t and its planning time; u_0 was drawn before the trial.

    It is what the policy chooses, unless the limits of the trial demand another one, cut to what
    the plant can apply.
    """
    trial, steps = trial_in(held), held.steps
    start, u = monotonic_microseconds(), trial.record.inputs[t]
    if t > 0:
        steps.plan(trial, t, u)
    else:
        copy_into(trial.randomness.inputs[0], u)
    steps.limit_input(trial, t, u)
    for j in range(u.shape[0]):
        if abs(u[j]) > trial.plant.cut_at:
            u[j] = trial.plant.cut_at if u[j] > 0.0 else -trial.plant.cut_at
    trial.record.plan_us[t] = monotonic_microseconds() - start


@compiled
def act(plant: Plant, x: Vector, u: Vector, noise: Vector, t: int, following: Vector) -> None:
    """Write x_{t+1} (equation 2) of the simulated system."""
    parameters = plant.history[min(t, plant.history.shape[0] - 1)]
    next_true_state(plant, parameters, x, u, following)
    for i in range(x.shape[0]):
        following[i] += noise[i]


@called_from_python
def act_next(held: HeldTrial, t: int) -> bool:
    """Write x_{t+1} of the simulated system and what is measured of it.

    Returns whether it is within the limit of the states.
    """
    trial = trial_in(held)
    plant, record = trial.plant, trial.record
    following = record.true_states[t + 1]
    noise = trial.randomness.noise[t]
    act(plant, record.true_states[t], record.inputs[t], noise, t, following)
    if has_sensors(trial.sensors):
        noise = trial.randomness.measurement_noise[t]
        measure(trial.sensors, noise, following, trial.state.estimate.outputs[t])
    return within(following, plant.state_limit)


@compiled
def observe(trial: Trial, steps: Steps, t: int, dt: float, target: Vector) -> None:
    """Write the accelerations observed from x_t to x_{t+1}, (r,), which came dt seconds later.

    Where states are measured with noise, x_{t+1} is estimated first.
    """
    steps.estimate_state(trial, t, dt)
    steps.observe(trial, t, dt, target)
    steps.note_error(trial, t, target)


@called_from_python
def learn_next(held: HeldTrial, t: int, target: Vector) -> bool:
    """Learn the accelerations observed in step t, (r,), and add the rows at (x_t, u_t) to M.

    Returns whether the parameters are finite: otherwise nothing is added.
    """
    trial = trial_in(held)
    plant, state, record = trial.plant, trial.state, trial.record
    clock_0 = monotonic_microseconds()
    learn_members(trial, held.steps.learn, t, target)
    clock_1 = monotonic_microseconds()
    if not within(state.theta, np.inf):
        return False
    trial.information.add_rows(plant, trial.network, state, sampled_point(trial, t))
    record.learn_us[t] = clock_1 - clock_0
    record.plan_us[t] += monotonic_microseconds() - clock_1
    return True


@compiled
def prediction_error(trial: Trial, steps: Steps, t: int, dt: float) -> float:
    """Return the error of the model at the accelerations observed from x_t to x_{t+1}.

    Of an ensemble the mean of the members is taken. Where states are measured with noise it is
    :func:`dopt.kernel.sensors.output_error`.
    """
    if has_sensors(trial.sensors):
        return output_error(trial, t, dt)
    plant, thetas, r = trial.plant, members_or_one(trial.state), trial.plant.learned_rows.shape[0]
    target, value, mean = np.empty(r), np.empty(r), np.zeros(r)
    steps.observe(trial, t, dt, target)
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
def observe_next(held: HeldTrial, t: int, dt: float, target: Vector) -> None:
    """Write the accelerations observed in step t (:func:`observe`), and their error as its loss."""
    trial, steps = trial_in(held), held.steps
    trial.record.loss[t] = prediction_error(trial, steps, t, dt)
    observe(trial, steps, t, dt, target)


@called_from_python
def take_in_next(held: HeldTrial, t: int, dt: float) -> bool:
    """Learn from x_t, u_t and x_{t+1}, dt seconds later, and return whether θ is finite.

    The loss of the step is the error of the accelerations before they are learned.
    """
    target = np.empty(trial_in(held).plant.learned_rows.shape[0])
    observe_next(held, t, dt, target)
    return learn_next(held, t, target)


@compiled
def evaluate(trial: Trial, points: Evaluation, t: int, thetas: Matrix, buffers: Buffers) -> bool:
    """Write the errors of the model after step t, and return whether that over the grid is finite.

    Parameters (members, q) and buffers belong to the whole trial.
    """
    plant, network, record, bounds = trial.plant, trial.network, trial.record, points.bounds
    start = monotonic_microseconds()
    if network.kind == ModelKind.GAUSSIAN_PROCESS:
        r = plant.learned_rows.shape[0]
        add_to_points(network, trial.state.theta, r, points)
    if plant.history.shape[0] > 1:
        follow_truth(plant, network, points, t)
    loss = model_error(plant, network, thetas, points, bounds[0], bounds[1], buffers)
    reachable_loss = model_error(plant, network, thetas, points, bounds[1], bounds[2], buffers)
    record.loss[t], record.reachable_loss[t] = loss, reachable_loss
    record.evaluate_us[t] = monotonic_microseconds() - start
    return bool(np.isfinite(loss))


@called_from_python
def evaluate_next(held: HeldTrial, points: Evaluation, t: int) -> bool:
    """Write the errors of the model after step t (:func:`evaluate`)."""
    trial = trial_in(held)
    thetas, r = members_or_one(trial.state), trial.plant.learned_rows.shape[0]
    return evaluate(trial, points, t, thetas, evaluation_buffers(trial.network, thetas, r))


@called_from_python
def advance(held: HeldTrial, points: Evaluation, first: int, last: int) -> int:
    """Run the steps from ``first`` to ``last`` in place.

    Returns the number of steps done from the start of the trial: ``last``, or the step at which the
    trial diverged.
    """
    trial, steps = trial_in(held), held.steps
    plant, thetas = trial.plant, members_or_one(trial.state)
    buffers = evaluation_buffers(trial.network, thetas, plant.learned_rows.shape[0])
    target = np.empty(plant.learned_rows.shape[0])
    for t in range(first, last):
        plan_next(held, t)
        if not act_next(held, t):
            return t
        observe(trial, steps, t, plant.dt, target)
        if not learn_next(held, t, target):
            return t
        if not evaluate(trial, points, t, thetas, buffers):
            return t
    return last


@called_from_python
def write_accelerations(held: HeldTrial, points: Matrix, out: Matrix) -> None:
    """Write a_θ, (N, r), at points, (N, ·)."""
    trial = trial_in(held)
    for n in range(points.shape[0]):
        model_accelerations(trial.plant, trial.network, trial.state.theta, points[n], out[n])


@called_from_python
def write_jacobian(held: HeldTrial, point: Matrix, out: Matrix) -> None:
    """Write ∂a_θ/∂θ, (r, q), at a point, (1, ·)."""
    trial = trial_in(held)
    rows = rows_at(trial.plant, trial.network, trial.state.theta, point)
    for k in range(rows.shape[0]):
        copy_into(rows[k], out[k])


@called_from_python
def write_jacobian_change(held: HeldTrial, point: Vector, directions: Matrix, out: Stack) -> None:
    """Write the derivative of ∂a_θ/∂θ along directions, (k, ·), of a point, (k, r, q)."""
    trial = trial_in(held)
    plant, network, theta = trial.plant, trial.network, trial.state.theta
    rows = np.empty((1 + directions.shape[0], theta.shape[0]))
    for i in range(out.shape[1]):
        write_gradients(plant, network, theta, point, directions, i, rows)
        for j in range(directions.shape[0]):
            copy_into(rows[1 + j], out[j, i])


@called_from_python
def write_following(held: HeldTrial, x: Vector, inputs: Matrix, out: Matrix) -> None:
    """Write the states, (N, d), that the model predicts after a state under inputs, (N, m)."""
    trial = trial_in(held)
    plant, theta = trial.plant, trial.state.theta
    for n in range(inputs.shape[0]):
        next_model_state(plant, trial.network, theta, x, inputs[n], plant.dt, out[n])


@called_from_python
def write_reached(held: HeldTrial, x: Vector, inputs: Matrix, seconds: Vector, out: Vector) -> None:
    """Write the state, (d,), that the model predicts after inputs, (n, m), held for times, (n,)."""
    trial, at = trial_in(held), x.copy()
    copy_into(x, out)
    for n in range(inputs.shape[0]):
        copy_into(out, at)
        theta, u, dt = trial.state.theta, inputs[n], seconds[n]
        next_model_state(trial.plant, trial.network, theta, at, u, dt, out)


@called_from_python
def write_input_matrix(held: HeldTrial, x: Vector, out: Matrix) -> None:
    """Write Bᵀ = dt (∂known/∂u)ᵀ, (m, d), at a state."""
    columns = input_columns(trial_in(held).plant, x)
    for j in range(columns.shape[0]):
        copy_into(columns[j], out[j])
