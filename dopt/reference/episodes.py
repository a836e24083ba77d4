"""Episodic planner over a batch of trials (:mod:`dopt.policies.episodic`)."""

from __future__ import annotations

from torch import Tensor

from dopt.policies.episodic import Episodic
from dopt.reference.sampling import SampledPlan, shifted
from dopt.reference.state import BatchState


class EpisodePlan(SampledPlan):
    """Cross-entropy search of every trial at some steps; its best plan gives the other inputs."""

    def __init__(self, batch: BatchState, policy: Episodic) -> None:
        super().__init__(batch, policy)
        self._episodes = policy

    def plan(self, t: int) -> Tensor:
        """Return the inputs u_t, (n, m)."""
        hold, last = self._episodes.hold, self._episodes.last_search(t)
        if last < t:
            return self._elites[:, 0, t // hold - last // hold]
        # The search itself drops the input whose time ends at this step.
        ended = t // hold - max(1, t - self._episodes.replan_every) // hold
        for _ in range(ended - (1 if t % hold == 0 else 0)):
            self._mean, self._elites = shifted(self._mean), shifted(self._elites)
        return super().plan(t)
