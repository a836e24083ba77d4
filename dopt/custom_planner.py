"""Plan of a trial whose policy brings one in numpy."""

from __future__ import annotations

from dopt.policies.base import CustomPolicy, Planner, TaskPolicy
from dopt.randomness import stream
from dopt.spec.trial import TrialSpec


def custom_planner(spec: TrialSpec) -> Planner | None:
    """Return a new plan of a trial; None where the policy brings none."""
    policy, system, rng = spec.policy, spec.system, stream(spec.seed, "planner")
    if isinstance(policy, TaskPolicy):
        return policy.task_planner(system, spec.config.goal, rng)
    return policy.planner(system, rng) if isinstance(policy, CustomPolicy) else None
