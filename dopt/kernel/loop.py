"""Algorithm 1 in compiled code: plan, act, observe, learn, update M, evaluate."""

from __future__ import annotations

import numpy as np

from dopt.algorithm import ModelKind
from dopt.kernel.checks import within
from dopt.kernel.compiler import called_from_python, compiled, monotonic_microseconds
from dopt.kernel.evaluation import add_sample, evaluation_buffers, follow_truth, model_error
from dopt.kernel.members import learn_members, members_or_one
from dopt.kernel.structs import Evaluation, Learn, Plan, Plant, Trial
from dopt.types import Vector


@compiled
def observe(
    plant: Plant, x: Vector, u: Vector, noise: Vector, t: int, following: Vector, target: Vector
) -> None:
    """Write x_{t+1} (equation 2) and the observed accelerations, (r,)."""
    flow = np.empty(x.shape[0])
    plant.known(x, u, plant.parameters, flow)
    plant.accelerations(x, plant.history[min(t, plant.history.shape[0] - 1)], target)
    for i in range(x.shape[0]):
        following[i] = flow[i]
    for k in range(target.shape[0]):
        following[plant.learned_rows[k]] += target[k]
    for i in range(x.shape[0]):
        following[i] = x[i] + plant.dt * following[i] + noise[i]
    for k in range(target.shape[0]):
        row = plant.learned_rows[k]
        target[k] = (following[row] - x[row]) / plant.dt - flow[row]


@called_from_python
def advance(
    trial: Trial, points: Evaluation, plan: Plan, learn: Learn, first: int, last: int
) -> int:
    """Run the steps from ``first`` to ``last`` in place.

    ``plan`` writes the input of a step, of which the first was drawn before the trial; ``learn``
    updates the parameters with the accelerations that were observed in it. Returns the number of
    steps done from the start of the trial: ``last``, or the step at which the trial diverged.
    """
    plant, network, record, theta = trial.plant, trial.network, trial.record, trial.state.theta
    thetas = members_or_one(trial.state)
    buffers = evaluation_buffers(network, thetas, plant.learned_rows.shape[0])
    target = np.empty(plant.learned_rows.shape[0])
    for t in range(first, last):
        clock_0 = monotonic_microseconds()
        x, following, u = record.states[t], record.states[t + 1], record.inputs[t]
        if t > 0:
            plan(trial, t, u)
        else:
            u[:] = trial.randomness.inputs[0]
        clock_1 = monotonic_microseconds()
        observe(plant, x, u, trial.randomness.noise[t], t, following, target)
        if not within(following, plant.state_limit):
            return t
        clock_2 = monotonic_microseconds()
        learn_members(trial, learn, t, target)
        clock_3 = monotonic_microseconds()
        if not within(theta, np.inf):
            return t
        trial.information.add_rows(plant, network, trial.state, x)
        clock_4 = monotonic_microseconds()
        if network.kind == ModelKind.GAUSSIAN_PROCESS:
            add_sample(network, points, x)
        if plant.history.shape[0] > 1:
            follow_truth(plant, network, points, t)
        loss = model_error(network, thetas, points, 0, points.n_grid, buffers)
        record.loss[t] = loss
        record.reachable_loss[t] = model_error(
            network, thetas, points, points.n_grid, points.n_all, buffers
        )
        clock_5 = monotonic_microseconds()
        record.plan_us[t] = (clock_1 - clock_0) + (clock_4 - clock_3)
        record.learn_us[t] = clock_3 - clock_2
        record.evaluate_us[t] = clock_5 - clock_4
        if not np.isfinite(loss):
            return t
    return last
