"""Rule that stops a configuration when its comparison with the reference is decided."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dopt.errors import suggestion
from dopt.spec.trial import TrialSpec
from dopt.stopping.family import newly_decided
from dopt.stopping.sign_flip_test import SignFlipTest
from orchestrate.errors import LaunchError
from orchestrate.runner.seed_rule import Losses, SeedRule, Seeds

Array = npt.NDArray[np.float64]


@dataclass
class Comparison:
    """One configuration against its reference.

    Attributes
    ----------
    reference
        Key of the reference's configuration.
    pairs
        Trial keys of the two on each seed that they share, with the number of seeds by which both
        are run; ascending in it.
    differences
        Log ratios of the final losses at the last look, NaN where one of the two has none.
    """

    reference: str
    pairs: list[tuple[int, str, str]]
    test: SignFlipTest = field(default_factory=SignFlipTest)
    differences: Array = field(default_factory=lambda: np.array([]))
    decided: bool = False

    def wants(self, n: int) -> bool:
        """Tell whether the first n seeds are not enough."""
        return not self.decided and any(needed > n for needed, _, _ in self.pairs)

    def look(self, n: int, losses: Losses) -> None:
        """Test the pairs of the first n seeds, if there are new ones."""
        pairs = [(variant, reference) for needed, variant, reference in self.pairs if needed <= n]
        if len(pairs) > len(self.differences):
            found = np.array([[losses.get(key, np.nan) for key in pair] for pair in pairs])
            self.differences = _log_ratios(found)
            self.test.look(self.differences, len(pairs) / len(self.pairs))

    def result(self) -> str:
        """Return the geometric mean of the ratio, and whether it is decided."""
        finite = self.differences[np.isfinite(self.differences)]
        ratio = f"ratio {np.exp(np.mean(finite)):.3g}" if len(finite) else "no ratio"
        return f"{ratio}, {'decided' if self.decided else 'not decided'}"


class DecidedComparisons(SeedRule):
    """Tests all comparisons of a grid together, with one error rate for all.

    A configuration is compared with the first one of the grid that has the reference policy, the
    same environment and the same model; where that model has none, with the first one of its
    environment.

    Parameters
    ----------
    seeds
        Trials of each configuration.
    policy
        Reference policy.

    Raises
    ------
    LaunchError
        If an environment has no configuration with that policy, or no other configuration.
    """

    def __init__(self, seeds: Seeds, policy: str) -> None:
        self._seeds = seeds
        references = dict(_references(seeds, policy))
        self._comparisons = {
            key: Comparison(reference, _pairs(seeds[key], seeds[reference]))
            for key, reference in references.items()
            if key != reference
        }
        for key, comparison in self._comparisons.items():
            if not comparison.pairs:
                raise LaunchError(
                    f"env={seeds[key][0].system.name} policy={seeds[key][0].policy.name} has no "
                    f"seed in common with its reference: give both the same seeds."
                )
        if not self._comparisons:
            raise LaunchError(
                f"launch.until=decided compares with launch.reference={policy}, but this grid has "
                f"no other configuration: add another policy or learner, or leave out launch.until."
            )
        named = {one.reference for one in self._comparisons.values()}
        self._alone = set(references) - set(self._comparisons) - named

    def wanting(self, n: int) -> set[str]:
        found = {key for key in self._alone if len(self._seeds[key]) > n}
        for key, comparison in self._comparisons.items():
            if comparison.wants(n):
                found |= {key, comparison.reference}
        return found

    def look(self, n: int, losses: Losses) -> None:
        undecided = {key: one for key, one in self._comparisons.items() if not one.decided}
        for comparison in undecided.values():
            comparison.look(n, losses)
        for key in newly_decided({key: one.test for key, one in undecided.items()}):
            self._comparisons[key].decided = True

    def result(self, config_key: str) -> str:
        comparison = self._comparisons.get(config_key)
        return comparison.result() if comparison else "reference"

    def summary(self) -> str:
        decided = sum(one.decided for one in self._comparisons.values())
        return f"{decided:,} of {len(self._comparisons):,} comparisons decided"


SHARED = ("env", "limits")
"""Sections that a configuration and its reference have in common."""


def _references(seeds: Seeds, policy: str) -> Iterator[tuple[str, str]]:
    """Yield each configuration with its reference, itself for a reference."""
    first = {key: trials[0] for key, trials in seeds.items()}
    found: dict[tuple[str, ...], str] = {}
    for key, trial in first.items():
        if trial.policy.name == policy:
            found.setdefault(_part(trial, *SHARED, "model"), key)
            found.setdefault(_part(trial, *SHARED), key)
    for key, trial in first.items():
        reference = found.get(_part(trial, *SHARED, "model")) or found.get(_part(trial, *SHARED))
        if reference is None:
            names = sorted({one.policy.name for one in first.values()})
            raise LaunchError(
                f"launch.until=decided compares with launch.reference={policy}, but this grid has "
                f"no such policy with env={trial.system.name}: add it to the grid, or set "
                f"launch.reference to a policy of the grid; {suggestion(policy, names)}"
            )
        yield key, reference


def _part(trial: TrialSpec, *sections: str) -> tuple[str, ...]:
    content = trial.to_mapping()
    return tuple(json.dumps(content.get(section), sort_keys=True) for section in sections)


def _pairs(own: list[TrialSpec], reference: list[TrialSpec]) -> list[tuple[int, str, str]]:
    places = {trial.seed: (place, trial.trial_key) for place, trial in enumerate(reference, 1)}
    pairs = [
        (max(place, places[trial.seed][0]), trial.trial_key, places[trial.seed][1])
        for place, trial in enumerate(own, 1)
        if trial.seed in places
    ]
    return sorted(pairs, key=lambda pair: pair[0])


def _log_ratios(losses: Array) -> Array:
    """Return the log ratios of losses (n, 2); of two that are equal it is 0, also of inf or 0."""
    variant, reference = losses.T
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios: Array = np.log(variant) - np.log(reference)
    return np.where(variant == reference, 0.0, ratios)
