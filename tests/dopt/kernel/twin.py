"""A trial of the reference that goes on from where a trial of the kernel stands."""

from __future__ import annotations

import numpy as np
import torch

from dopt.kernel.run import KernelTrial
from dopt.reference.batch import Lockstep
from dopt.reference.dynamics import known_flow
from dopt.reference.learning import AdamLearner


def transplant(trial: KernelTrial, parameters: np.ndarray | None = None) -> Lockstep:
    """Return a batch of one trial with the kernel's parameters, moments and history.

    M is summed afresh from the rows at the ``parameters``, (t, q), after each of the steps done;
    without them it is M₀.
    """
    t, state, record = trial.done, trial.state, trial.record
    twin = Lockstep([trial.spec])
    twin.theta.copy_(torch.tensor(state.theta)[None])
    twin.states[0, : t + 1] = torch.tensor(record.states[: t + 1])
    twin.inputs[0, :t] = torch.tensor(record.inputs[:t])
    twin.sampled_states[0, :t] = twin.states[0, :t]  # by the Euler map
    twin.targets[:, :t] = observed(twin, t)
    if twin.information is not None and parameters is not None:
        J = twin.learned.jacobian(torch.tensor(parameters), twin.states[0, :t].unsqueeze(1))
        twin.information.add(J.flatten(0, 2)[None])
    if isinstance(twin.learner, AdamLearner):
        twin.learner.n_steps = t
        twin.learner.moments = tuple(
            torch.tensor(moment)[None] for moment in (state.moment_1, state.moment_2)
        )
    return twin


def observed(twin: Lockstep, t: int) -> torch.Tensor:
    """Return the accelerations observed in the first t steps, (1, t, r)."""
    states, system = twin.states[:, : t + 1], twin.system
    flow = (states[:, 1:] - states[:, :-1]) / system.dt
    known = known_flow(system, states[:, :-1], twin.inputs[:, :t])
    return (flow - known)[..., list(system.learned_rows)]


def relative_gap(values: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest difference between two arrays beside the largest entry."""
    return float(np.abs(values - expected).max() / np.abs(expected).max())
