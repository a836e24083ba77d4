"""Small trials of the agents."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dopt.spec.trial import TrialSpec
from tests.dopt.trials import trial

SMALL: dict[str, dict[str, Any]] = {
    "SoftActorCritic": {"hold": 3, "warm_up": 9, "units": 8, "batch": 4},
    "ActiveExploration": {
        **{"ensemble": 3, "units": 8, "warm_up": 10, "replan_every": 10, "fit_updates": 20},
        **{"hold": 4, "lookahead": 6, "actors": 6, "episodes": 2, "batch": 8},
    },
}
AGENTS = tuple(SMALL)


def agent_trial(env: str, agent: str, seed: int = 0, /, **fields: Mapping[str, Any]) -> TrialSpec:
    """Return a small trial of an agent; ``fields`` are the entries of sections that differ."""
    target = {"_target_": f"studies.agents.policies.{agent}", **SMALL[agent]}
    policy, task = target | dict(fields.pop("policy", {})), fields.pop("task", None)
    sections = trial(env, "random", seed, **fields).to_mapping() | {"policy": policy}
    return TrialSpec.from_mapping(sections | ({"task": task} if task else {}))
