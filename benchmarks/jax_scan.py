"""Speed of the same trial as a compiled JAX scan, where JAX is installed.

It chooses the kernel's inputs: the same equations, random numbers and rules. The table says how
many of its first inputs are the kernel's; where rounding once decides otherwise, the two part.
"""

from __future__ import annotations

import importlib.util
import itertools
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FunctionType
from typing import Any

import numpy as np

from benchmarks.rows import Row
from benchmarks.trials import TINY_GRID, cartpole, cost, step_us
from dopt.learning import Adam
from dopt.models import MLP
from dopt.policies import DOptimal
from dopt.randomness import draw
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems.base import feature_values


def jax_scan(quick: bool) -> list[Row]:
    """Return the cost of a step of the scan, run in turn with the kernel.

    Both are the quickest of several trials, and the scan is timed by the processor's seconds: on
    one core of a busy machine its wall time was six times as long, where the kernel's clocks saw
    single steps and did not notice. Off one core its client hands products to threads (2.5 times).
    """
    if importlib.util.find_spec("jax") is None:
        return [Row("JAX lax.scan of the same step", None, note="jax is not installed")]
    rounds, one_sample = 1 if quick else 5, cartpole(learner="adam", grid=TINY_GRID)
    with on_one_core():
        return [
            _compare("JAX scan, window of 100", cartpole(grid=TINY_GRID), rounds),
            _compare("JAX scan, one sample", one_sample, rounds),
        ]


@contextmanager
def on_one_core() -> Iterator[None]:
    """Keep this process on one core: XLA hands small products to threads, which slows it down."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _compare(what: str, spec: TrialSpec, rounds: int) -> Row:
    scan = compile_scan(spec)
    scan(spec)
    kernel, costs = [run_trial(spec)], []
    for seed in range(rounds):
        kernel.append(run_trial(spec.with_seed(seed)))
        start = time.process_time()
        inputs = scan(spec.with_seed(seed))
        costs.append(1e6 * (time.process_time() - start) / spec.system.horizon)
    theirs, ours = min(costs), cost(kernel[1:], step_us).mean
    same = np.isclose(inputs, kernel[-1].inputs, rtol=1e-6).all(axis=1)
    agreed = len(same) if same.all() else int(np.argmin(same))
    note = f"kernel in turn {ours:.0f} µs, {theirs / ours:.2f} times faster; {agreed} inputs equal"
    return Row(what, theirs, "µs a step", note=note)


def compile_scan(spec: TrialSpec) -> Callable[[TrialSpec], Any]:
    """Return a function from a trial with one input to its inputs, (T, 1), run as one scan.

    Nothing is evaluated on the way. Letters as in :mod:`dopt.reference.models`.
    """
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    system, model, learner, policy = spec.system, spec.model, spec.learner, spec.policy
    assert isinstance(model, MLP)
    assert isinstance(learner, Adam)
    assert isinstance(policy, DOptimal)
    sizes, rows = model.layer_sizes(system), jnp.array(system.learned_rows)
    names = {"sin": jnp.sin, "cos": jnp.cos}
    known_terms = _with(type(system).known, names)
    truth = _with(type(system).accelerations, names)
    featurize = _with(feature_values, names)
    window, dt, gamma = learner.window, system.dt, system.gamma

    def network(theta: Any, x: Any) -> Any:
        h = jnp.stack(featurize(system.features, system.feature_scales, x))
        start = 0
        for layer, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
            W = theta[start : start + n_in * n_out].reshape(n_out, n_in)
            start += (n_in + 1) * n_out
            h = W @ h + theta[start - n_out : start]
            h = jnp.tanh(h) if layer < len(sizes) - 2 else h
        return h

    def known_flow(x: Any, u: Any) -> Any:
        return jnp.stack([jnp.asarray(term) for term in known_terms(x, u, system.parameters)])

    def gradient(theta: Any, x: Any, k: Any) -> Any:
        return jax.grad(lambda p: network(p, x)[k])(theta)

    def plan(theta: Any, inverse: Any, x: Any, k: Any, tie: Any) -> Any:
        flow = known_flow(x, jnp.zeros(1)).at[rows].add(network(theta, x))
        bar = x + dt * flow
        column = dt * jax.jvp(lambda u: known_flow(bar, u), (jnp.zeros(1),), (jnp.ones(1),))[1]
        g, change = jax.jvp(lambda z: gradient(theta, z, k), (bar,), (column,))
        slope = (inverse @ g) @ change
        return gamma * jnp.where(slope == 0.0, jnp.sign(tie), jnp.sign(slope))

    def loss(theta: Any, states: Any, targets: Any, used: Any) -> Any:
        errors = jax.vmap(network, (None, 0))(theta, states) - targets
        return jnp.sum(used[:, None] * errors**2) / jnp.sum(used)

    def adam(theta: Any, moments: Any, slope: Any, t: Any) -> Any:
        first = learner.beta_1 * moments[0] + (1 - learner.beta_1) * slope
        second = learner.beta_2 * moments[1] + (1 - learner.beta_2) * slope**2
        size = jnp.sqrt(second / (1 - learner.beta_2 ** (t + 1))) + learner.epsilon
        step = learner.learning_rate * first / (1 - learner.beta_1 ** (t + 1)) / size
        return theta - step, (first, second)

    def inform(theta: Any, inverse: Any, x: Any) -> Any:
        J = jax.jacrev(network)(theta, x)
        V = J @ inverse
        L = jnp.linalg.cholesky(jnp.eye(len(V)) + V @ J.T)
        W = jax.scipy.linalg.solve_triangular(L, V, lower=True)
        return inverse - W.T @ W  # symmetric: otherwise rounding grows from step to step

    def step(carry: Any, drawn: Any) -> Any:
        x, theta, moments, inverse, states, targets = carry
        t, noise, first, k, tie = drawn
        u = jnp.where(t == 0, first, plan(theta, inverse, x, k, tie))
        flow = known_flow(x, u)
        following = x + dt * flow.at[rows].add(jnp.stack(truth(x, system.parameters))) + noise
        states = states.at[t % window].set(x)
        targets = targets.at[t % window].set(((following - x) / dt - flow)[rows])
        used = (jnp.arange(window) <= t).astype(float)
        theta, moments = adam(theta, moments, jax.grad(loss)(theta, states, targets, used), t)
        return (following, theta, moments, inform(theta, inverse, x), states, targets), u

    def trial(weights: Any, drawn: Any) -> Any:
        q, d = len(weights), system.n_states
        blank = (jnp.zeros((window, d)), jnp.zeros((window, system.n_learned)))
        zeros = (jnp.zeros(q), jnp.zeros(q))
        start = (jnp.array(system.initial_state), weights, zeros)
        _, inputs = jax.lax.scan(step, (*start, jnp.eye(q) / policy.regularization, *blank), drawn)
        return inputs

    compiled = jax.jit(trial)

    def run(one: TrialSpec) -> Any:
        d = draw(one)
        drawn = (np.arange(system.horizon), d.noise, d.inputs, d.components, d.ties)
        return np.asarray(compiled(d.weights, drawn))

    return run


def _with(function: Callable[..., Any], names: dict[str, Any]) -> Callable[..., Any]:
    """Return a copy of a function with the elementary functions of JAX."""
    assert isinstance(function, FunctionType)
    return FunctionType(
        function.__code__, {**function.__globals__, **names}, closure=function.__closure__
    )
