"""Algorithm 1 in compiled code: plan, act, observe, learn, inform, evaluate."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from dopt.kernel.arguments import (
    ADAM,
    D_OPTIMAL,
    LEAST_SQUARES,
    OPEN_LOOP,
    Evaluation,
    Network,
    Randomness,
    Record,
    Rules,
    State,
    World,
)
from dopt.kernel.compiler import compiled, monotonic_microseconds
from dopt.kernel.evaluation import BLOCK, model_error
from dopt.kernel.information import absorb
from dopt.kernel.learning import adam_step
from dopt.kernel.model import jacobian_rows
from dopt.kernel.network import features_at
from dopt.kernel.policies import d_optimal_input, uniform_input


@compiled
def plan(
    known: Any,
    accelerations: Any,
    complex_accelerations: Any,
    world: World,
    network: Network,
    rules: Rules,
    randomness: Randomness,
    state: State,
    states: Any,
    t: int,
) -> Any:
    """Return the input u_t, (m,); the first of a closed-loop policy is random."""
    if rules.policy == OPEN_LOOP or t == 0:
        return randomness.inputs[t].copy()
    if rules.policy == D_OPTIMAL:
        return d_optimal_input(
            known,
            accelerations,
            complex_accelerations,
            world,
            network,
            state,
            states[t],
            randomness.components[t],
            randomness.ties[t],
        )
    return uniform_input(
        known, accelerations, world, network, state, states, t, rules.ascent_steps
    )


@compiled
def observe(
    known: Any, accelerations: Any, world: World, x: Any, u: Any, noise: Any, following: Any
) -> Any:
    """Write x_{t+1} (equation 2) and return the observed accelerations, (r,)."""
    flow = np.empty_like(x)
    known(x, u, world.parameters, flow)
    a = np.empty(world.learned_rows.shape[0])
    accelerations(x, world.parameters, a)
    total = flow.copy()
    for k in range(a.shape[0]):
        total[world.learned_rows[k]] += a[k]
    following[:] = x + world.dt * total + noise
    for k in range(a.shape[0]):
        row = world.learned_rows[k]
        a[k] = (following[row] - x[row]) / world.dt - flow[row]
    return a


@compiled
def within(x: Any, limit: float) -> bool:
    """Tell whether every entry is finite and within the limit."""
    return bool(np.all(np.abs(x) <= limit))


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def advance(
    known: Any,
    accelerations: Any,
    complex_accelerations: Any,
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
    learning = (
        np.empty((depth, rules.window, width)),
        np.empty((rules.window, r)),
        np.empty((2, rules.window, width)),
    )
    evaluating = (np.empty((depth, BLOCK, width)), np.empty((BLOCK, r)))
    gradient, rows, scratch = np.empty(q), np.empty((r, q)), np.empty((r, q))
    informed = rules.policy == D_OPTIMAL or rules.learner == LEAST_SQUARES
    for t in range(first, last):
        clock_0 = monotonic_microseconds()
        u = plan(
            known,
            accelerations,
            complex_accelerations,
            world,
            network,
            rules,
            randomness,
            state,
            record.states,
            t,
        )
        clock_1 = monotonic_microseconds()
        x, following = record.states[t], record.states[t + 1]
        target = observe(known, accelerations, world, x, u, randomness.noise[t], following)
        record.inputs[t] = u
        if not within(following, world.state_limit):
            return t
        clock_2 = monotonic_microseconds()
        if rules.learner == ADAM:
            slot = t % rules.window
            features_at(network, x, state.window_features[slot])
            state.window_targets[slot] = target
            adam_step(network, rules, state, t, learning, gradient)
        clock_3 = monotonic_microseconds()
        if not within(state.theta, np.inf):
            return t
        if informed:
            predicted = jacobian_rows(accelerations, world, network, state.theta, x, rows)
            residuals = target - predicted
            absorb(state.covariance, rows, residuals, scratch)
            if rules.learner == LEAST_SQUARES:
                for k in range(r):
                    for i in range(q):
                        state.theta[i] += residuals[k] * scratch[k, i]
        clock_4 = monotonic_microseconds()
        end = points.targets.shape[0]
        loss = model_error(network, state.theta, points, 0, points.n_grid, evaluating)
        record.loss[t] = loss
        record.reachable_loss[t] = model_error(
            network, state.theta, points, points.n_grid, end, evaluating
        )
        clock_5 = monotonic_microseconds()
        record.plan_us[t] = (clock_1 - clock_0) + (clock_4 - clock_3)
        record.learn_us[t] = clock_3 - clock_2
        record.evaluate_us[t] = clock_5 - clock_4
        if not np.isfinite(loss):
            return t
    return last
