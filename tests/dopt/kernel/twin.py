"""A trial of the torch path that goes on from where a trial of the kernel stands."""

from __future__ import annotations

import numpy as np
import torch

from dopt.kernel.run import KernelTrial
from dopt.reference.batch import AdamLearner, Lockstep
from dopt.reference.models import jacobian
from dopt.types import Array


def transplant(trial: KernelTrial, parameters: Array) -> Lockstep:
    """Return a batch of one trial with the kernel's parameters, moments and history.

    M is summed afresh from the rows at the ``parameters``, (t, q), after each of the steps done.
    """
    t, state, record = trial.done, trial.state, trial.record
    twin = Lockstep([trial.spec])
    twin.theta.copy_(torch.tensor(state.theta)[None])
    twin.states[0, : t + 1] = torch.tensor(record.states[: t + 1])
    twin.inputs[0, :t] = torch.tensor(record.inputs[:t])
    twin.sampled_states[0, :t] = twin.states[0, :t]  # by the Euler map
    twin.targets[0, :t] = torch.tensor(observed(trial, t))
    if twin.information is not None:
        rows, x = torch.tensor(parameters), twin.states[0, :t].unsqueeze(1)
        J = jacobian(twin.model, twin.system.n_learned, rows, x)
        twin.information.add(J.flatten(0, 2)[None])
    assert isinstance(twin.learner, AdamLearner)
    for ours, theirs in zip(twin.learner._moments, (state.moment_1, state.moment_2), strict=True):
        ours.copy_(torch.tensor(theirs)[None])
    return twin


def observed(trial: KernelTrial, t: int) -> Array:
    """Return the accelerations observed in the first t steps by the Euler map, (t, r)."""
    system, states = trial.spec.system, trial.record.states[: t + 1]
    x, u = states[:-1], trial.record.inputs[:t]
    known = system.known(tuple(x.T), tuple(u.T), system.parameters)
    flow = np.stack(np.broadcast_arrays(*known, x[:, 0])[:-1], axis=-1)
    found: Array = ((states[1:] - x) / system.dt - flow)[:, list(system.learned_rows)]
    return found


def relative_gap(values: Array, expected: Array) -> float:
    """Return the largest difference between two arrays beside the largest entry."""
    return float(np.abs(values - expected).max() / np.abs(expected).max())
