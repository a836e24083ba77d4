"""Plans in torch of closed-loop policies that plan by an algorithm of their own, by class."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from torch import Tensor

from dopt.policies.disagreement import Disagreement
from dopt.policies.episodic import Episodic
from dopt.policies.gaussian_process import GaussianProcessEntropy
from dopt.policies.gradient import GradientDOptimal
from dopt.policies.greedy_linear import GreedyLinear
from dopt.policies.icem import ICEM
from dopt.reference.ensemble import EnsemblePlan
from dopt.reference.episodes import EpisodePlan
from dopt.reference.exact_gain import GradientPlan
from dopt.reference.gaussian_process import EntropyPlan, Posterior
from dopt.reference.greedy_linear import GreedyLinearPlan
from dopt.reference.sampling import SampledPlan
from dopt.reference.state import BatchState


class Plan(Protocol):
    """Planner that chooses the inputs of a batch of n trials."""

    def plan(self, t: int) -> Tensor:
        """Return the inputs u_t, (n, m), for t ≥ 1."""

    def inform(self, t: int) -> None:
        """Take in step t, which was just done and learned from."""


PLANS: dict[type, Callable[[BatchState, Any], Plan]] = {
    Disagreement: EnsemblePlan,
    GradientDOptimal: GradientPlan,
    GreedyLinear: GreedyLinearPlan,
    ICEM: SampledPlan,
    Episodic: EpisodePlan,
}


def plan_for(batch: BatchState, learner: object) -> Plan | None:
    """Return the plan of a batch; None for a policy that has none of its own here."""
    policy = batch.config.policy
    if isinstance(policy, GaussianProcessEntropy):
        assert isinstance(learner, Posterior)
        return EntropyPlan(batch, policy, learner)
    make = PLANS.get(type(policy))
    return make(batch, policy) if make else None
