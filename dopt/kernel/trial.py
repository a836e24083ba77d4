"""Algorithm 1 in compiled code: plan, act, observe, learn, inform, evaluate."""

from __future__ import annotations

from typing import Any

import numpy as np

from dopt.kernel.arguments import (
    ADAM,
    D_OPTIMAL,
    DUAL,
    KALMAN,
    LEAST_SQUARES,
    LINEAR_MODEL,
    OPEN_LOOP,
    REPLAY,
    SEARCH,
    SKETCH,
    Evaluation,
    Network,
    Randomness,
    Record,
    Rules,
    State,
    World,
)
from dopt.kernel.checks import within
from dopt.kernel.compiler import called_from_python, compiled, monotonic_microseconds
from dopt.kernel.dual import dual_absorb
from dopt.kernel.evaluation import evaluation_buffers, follow_truth, model_error
from dopt.kernel.forgetting import fade
from dopt.kernel.information import absorb
from dopt.kernel.learning import adam_step, remember, replay_steps
from dopt.kernel.model import add_linear, all_components, network_rows, regressors
from dopt.kernel.policies import d_optimal_input, uniform_input
from dopt.kernel.sketch import sketched


@compiled
def plan(
    known: Any,
    accelerations: Any,
    complex_accelerations: Any,
    search: Any,
    world: World,
    network: Network,
    rules: Rules,
    randomness: Randomness,
    state: State,
    states: Any,
    t: int,
    u: Any,
) -> None:
    """Write the input u_t, (m,); the first of a closed-loop policy is random."""
    if rules.policy == OPEN_LOOP or t == 0:
        for j in range(u.shape[0]):
            u[j] = randomness.inputs[t, j]
    elif rules.policy == D_OPTIMAL:
        component, tie = randomness.components[t], randomness.ties[t]
        d_optimal_input(
            known,
            accelerations,
            complex_accelerations,
            world,
            network,
            rules,
            state,
            states[t],
            component,
            tie,
            u,
        )
    elif rules.policy == SEARCH:
        x, tie = states[t], randomness.ties[t]
        theta, covariance = state.theta, state.covariance
        search(known, accelerations, world, network, rules.search, theta, covariance, x, tie, u)
    else:
        steps = rules.ascent_steps
        uniform_input(known, accelerations, world, network, state, states, t, steps, u)


@compiled
def observe(
    known: Any,
    accelerations: Any,
    world: World,
    x: Any,
    u: Any,
    noise: Any,
    t: int,
    following: Any,
    target: Any,
) -> None:
    """Write x_{t+1} (equation 2) and the observed accelerations, (r,)."""
    flow = np.empty(x.shape[0])
    known(x, u, world.parameters, flow)
    accelerations(x, world.history[min(t, world.history.shape[0] - 1)], target)
    for i in range(x.shape[0]):
        following[i] = flow[i]
    for k in range(target.shape[0]):
        following[world.learned_rows[k]] += target[k]
    for i in range(x.shape[0]):
        following[i] = x[i] + world.dt * following[i] + noise[i]
    for k in range(target.shape[0]):
        row = world.learned_rows[k]
        target[k] = (following[row] - x[row]) / world.dt - flow[row]


@compiled
def inform(
    accelerations: Any,
    world: World,
    network: Network,
    rules: Rules,
    state: State,
    t: int,
    x: Any,
    target: Any,
) -> None:
    """Add JᵀJ at a state to M, and take the least-squares or Kalman step that goes with it."""
    q, r = state.theta.shape[0], target.shape[0]
    residuals = np.empty(r)
    if network.kind == LINEAR_MODEL:
        rows = np.empty((r, q))
        regressors(accelerations, world, x, rows, residuals)
        add_linear(rows, state.theta, residuals)
    else:
        phi, hidden, deltas = all_components(network, state.theta, x, residuals)
        if rules.form == DUAL:
            dual_absorb(state.dual, rules.regularization, phi, hidden, deltas)
            return
        rows = network_rows(network, phi, hidden, deltas, q)
        if rules.form == SKETCH:
            rows = sketched(state.sketch, rows)
    for k in range(r):
        residuals[k] = target[k] - residuals[k]
    if rules.learner == KALMAN:
        _weigh(rules, state, t, rows, residuals)
    scratch = np.empty(rows.shape)
    absorb(state.covariance, rows, residuals, scratch)
    learns = rules.learner == LEAST_SQUARES or rules.learner == KALMAN
    for k in range(r if learns else 0):
        for i in range(q):
            state.theta[i] += residuals[k] * scratch[k, i]


@compiled
def _weigh(rules: Rules, state: State, t: int, rows: Any, residuals: Any) -> None:
    """Let M fade, and divide J, (r, q), and the residuals, (r,), by √ρ."""
    if rules.forgetting < 1.0:
        fade(state.covariance, rules.forgetting, t, rules.renewed, rules.renewal)
    scale = 1.0 / np.sqrt(rules.noise_variance)
    for k in range(rows.shape[0]):
        residuals[k] *= scale
        for i in range(rows.shape[1]):
            rows[k, i] *= scale


@called_from_python
def advance(
    known: Any,
    accelerations: Any,
    complex_accelerations: Any,
    search: Any,
    world: World,
    network: Network,
    rules: Rules,
    randomness: Randomness,
    points: Evaluation,
    state: State,
    record: Record,
    first: int,
    last: int,
) -> int:
    """Run the steps from ``first`` to ``last`` in place.

    Returns the number of steps done from the start of the trial: ``last``, or the step at which
    the trial diverged.
    """
    q, r = state.theta.shape[0], world.learned_rows.shape[0]
    depth, width = network.offsets.shape[0] - 1, network.sizes[1]
    room = max(width, r) * rules.batch
    learning = (np.empty((depth, room)), np.empty((3, room)))
    evaluating = evaluation_buffers(network, q, r)
    gradient, target = np.empty(q), np.empty(r)
    for t in range(first, last):
        clock_0 = monotonic_microseconds()
        x, following, u = record.states[t], record.states[t + 1], record.inputs[t]
        plan(
            known,
            accelerations,
            complex_accelerations,
            search,
            world,
            network,
            rules,
            randomness,
            state,
            record.states,
            t,
            u,
        )
        clock_1 = monotonic_microseconds()
        observe(known, accelerations, world, x, u, randomness.noise[t], t, following, target)
        if not within(following, world.state_limit):
            return t
        clock_2 = monotonic_microseconds()
        if rules.learner == ADAM:
            remember(network, rules, state, t, x, target)
            adam_step(network, rules, state, t, learning, gradient)
        elif rules.learner == REPLAY:
            remember(network, rules, state, t, x, target)
            replay_steps(network, rules, state, t, randomness.replay[t], learning, gradient)
        elif rules.learner == KALMAN:
            inform(accelerations, world, network, rules, state, t, x, target)
        clock_3 = monotonic_microseconds()
        if not within(state.theta, np.inf):
            return t
        if rules.informed and rules.learner != KALMAN:
            inform(accelerations, world, network, rules, state, t, x, target)
        clock_4 = monotonic_microseconds()
        if world.history.shape[0] > 1:
            follow_truth(accelerations, world, network, points, t)
        loss = model_error(network, state.theta, points, 0, points.n_grid, evaluating)
        record.loss[t] = loss
        record.reachable_loss[t] = model_error(
            network, state.theta, points, points.n_grid, points.n_all, evaluating
        )
        clock_5 = monotonic_microseconds()
        record.plan_us[t] = (clock_1 - clock_0) + (clock_4 - clock_3)
        record.learn_us[t] = clock_3 - clock_2
        record.evaluate_us[t] = clock_5 - clock_4
        if not np.isfinite(loss):
            return t
    return last
