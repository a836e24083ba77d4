"""Episodic planner in compiled code (:mod:`dopt.policies.icem`).

Its numbers are those of the sampling planner and the steps k from one search to the next.
"""

from __future__ import annotations

from dopt.kernel.compiler import compiled
from dopt.kernel.search.sampling import plan as search
from dopt.kernel.search.sampling import settings_of
from dopt.kernel.structs import Trial
from dopt.types import Stack, Vector


@compiled
def plan(trial: Trial, t: int, u: Vector) -> None:
    """Write the next input of the best plan, (m,); NaN where a search finds M indefinite."""
    numbers = trial.algorithm.policy
    settings, every = settings_of(numbers), int(numbers[numbers.shape[0] - 1])
    hold, K = settings.hold, (settings.steps + settings.hold - 1) // settings.hold + 1
    memory = trial.state.policy_memory.reshape(1 + settings.elites, K, u.shape[0])
    last = max(1, t - t % every)
    if last < t:
        u[:] = memory[1, t // hold - last // hold]  # of the best elite
        return
    # The search itself drops the input whose time ends at this step.
    ended = t // hold - max(1, t - every) // hold
    _drop(memory, max(0, ended - (1 if t % hold == 0 else 0)))
    search(trial, t, u)


@compiled
def _drop(memory: Stack, count: int) -> None:
    """Drop the first inputs of every plan, whose time has ended, and repeat the last."""
    final = memory.shape[1] - 1
    for k in range(final):
        memory[:, k] = memory[:, min(k + count, final)]
