"""Contents of a trial before each of its steps, and its model in plain numpy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.kernel.run import trial_in_kernel
from dopt.kernel.structs import Record
from dopt.spec.trial import TrialSpec
from dopt.types import Array

STEP = 1e-30


class Trace(NamedTuple):
    """A trial step by step."""

    states: Array  # (T + 1, d), known or estimated
    inputs: Array  # (T, m)
    parameters: Array  # (T + 1, q) before each step, and after the last


def trace(spec: TrialSpec) -> Trace:
    """Run a trial in the kernel, one step after the other."""
    trial = trial_in_kernel(spec)
    parameters = [trial.parameters.copy()]
    for t in range(spec.system.horizon):
        trial.advance(t + 1)
        assert trial.diverged_at is None
        parameters.append(trial.parameters.copy())
    return Trace(trial.record.states, trial.record.inputs, np.array(parameters))


def jacobian(spec: TrialSpec, theta: Array, points: Array) -> Array:
    """Return J, (N, r, q), of the learned parameters at points (N, ·)."""
    q = len(theta) - spec.model.n_fixed_parameters(spec.system)
    moved = theta + 1j * STEP * np.eye(q, len(theta))
    columns = [spec.model.predict_at(spec.system, one, points).imag / STEP for one in moved]
    return np.stack(columns, axis=-1)


def accelerations(spec: TrialSpec, theta: Array, x: Array, u: Array) -> Array:
    """Return a_θ, (r,), at a state under an input."""
    return spec.model.predict(spec.system, theta, x[None], u[None])[0]


def following(spec: TrialSpec, x: Array, u: Array, learned: Array) -> Array:
    """Return x + dt f(x, u), (d,), with learned accelerations, (r,)."""
    flow = np.array(spec.system.known(tuple(x), tuple(u), spec.system.parameters), dtype=float)
    flow[list(spec.system.learned_rows)] += learned
    after: Array = x + spec.system.dt * flow
    return after


def model_step(spec: TrialSpec, theta: Array, x: Array, u: Array) -> Array:
    """Return x + dt f_θ(x, u), (d,)."""
    return following(spec, x, u, accelerations(spec, theta, x, u))


def observed(spec: TrialSpec, run: Trace | Record) -> Array:
    """Return the accelerations, (T, r), that the steps of a trial by the Euler map show."""
    system, x, u = spec.system, run.states[:-1], run.inputs
    known = system.known(tuple(x.T), tuple(u.T), system.parameters)
    flow = np.stack(np.broadcast_arrays(*known, x[:, 0])[:-1], axis=-1)
    found: Array = ((run.states[1:] - x) / system.dt - flow)[:, list(system.learned_rows)]
    return found


def information(spec: TrialSpec, run: Trace, t: int, ridge: float) -> Array:
    """Return M, (q, q), before step t: λI and JᵀJ, each at the parameters after its own step."""
    rows = [jacobian(spec, run.parameters[s + 1], run.states[s : s + 1])[0] for s in range(t)]
    q = len(run.parameters[0]) - spec.model.n_fixed_parameters(spec.system)
    return ridge * np.eye(q) + sum((J.T @ J for J in rows), start=np.zeros((q, q)))
