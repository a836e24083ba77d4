"""Trials that a complete grid would have and the database has not finished."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from dopt.errors import IncompatibleError, SpecificationError
from dopt.policies import POLICIES
from dopt.spec.prequential import is_prequential, stored_trial
from dopt.systems import NAMED_SYSTEMS
from orchestrate.store import ConfigRow

Compatible = Callable[[ConfigRow, ConfigRow], bool]


@dataclass(frozen=True)
class Gap:
    """Seeds of one environment and policy that are not finished, and in which state they are."""

    env: str
    policy: str
    seeds: tuple[int, ...]
    states: str

    def describe_seeds(self) -> str:
        """Return the seeds as ranges, such as ``0-4, 7``."""
        return ranges(self.seeds)


def ranges(seeds: Iterable[int]) -> str:
    """Return whole numbers as a short text of ranges."""
    runs: list[list[int]] = []
    for seed in sorted(seeds):
        if runs and seed == runs[-1][1] + 1:
            runs[-1][1] = seed
        else:
            runs.append([seed, seed])
    return ", ".join(str(low) if low == high else f"{low}-{high}" for low, high in runs)


def is_possible(policy: ConfigRow, environment: ConfigRow) -> bool:
    """Whether a policy's configuration makes sense with another environment's section."""
    config = {key: value for key, value in policy.config.items() if key in _SECTIONS}
    try:
        stored_trial({**config, "env": environment.config["env"]})
    except IncompatibleError:
        return False
    except SpecificationError:
        return True
    return True


def why_impossible(env: str, policy: str) -> str | None:
    """Return why an environment cannot have a policy, or None where it can for all we know."""
    if env not in NAMED_SYSTEMS or policy not in POLICIES:
        return None
    try:
        POLICIES[policy]().check(NAMED_SYSTEMS[env]())
    except IncompatibleError as error:
        return str(error).partition(": ")[0]
    return None


_SECTIONS = ("env", "policy", "model", "learner")


def absent_pairs(
    configs: Sequence[ConfigRow], compatible: Compatible = is_possible
) -> list[tuple[str, str]]:
    """Return the (environment, policy) pairs of which nothing is stored though they make sense.

    Nothing is expected of explorations.
    """
    stored = {(config.env, config.policy) for config in configs}
    simulated = [config for config in configs if not is_prequential(config.config)]
    environments = {config.env: config for config in simulated}
    policies = {config.policy: config for config in simulated}
    return [
        (env, policy)
        for env in environments
        for policy in policies
        if (env, policy) not in stored and compatible(policies[policy], environments[env])
    ]
