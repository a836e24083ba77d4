"""Interface of a rule by which a configuration gets no more of its seeds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping

from dopt.spec.trial import TrialSpec

Losses = Mapping[str, float]
"""Final loss by trial key, of the trials that are done and did not diverge."""

Seeds = Mapping[str, list[TrialSpec]]
"""Trials of each configuration, by its key, in the order of the seeds."""


class SeedRule(ABC):
    """Rule that looks at the results after each batch of seeds.

    What it finds is a function of the losses in the order of the seeds, and not of the order in
    which trials finished or of the launch that ran them.
    """

    @abstractmethod
    def wanting(self, n: int) -> set[str]:
        """Return the keys of the configurations that need more than their first n seeds."""

    @abstractmethod
    def look(self, n: int, losses: Losses) -> None:
        """Look at the losses of the first n seeds of the configurations that needed them."""

    @abstractmethod
    def result(self, config_key: str) -> str:
        """Return what the rule found for a configuration."""

    @abstractmethod
    def summary(self) -> str:
        """Return how much is decided."""


def by_config(trials: Iterable[TrialSpec]) -> Seeds:
    """Return the trials by the key of their configuration, in their order."""
    found: dict[str, list[TrialSpec]] = {}
    for trial in trials:
        found.setdefault(trial.config_key, []).append(trial)
    return found
