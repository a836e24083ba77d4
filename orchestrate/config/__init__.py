"""Configuration of a launch: overrides, sweeps and the grid of trials that they ask for.

This module holds the grid, built from the combinations of a command line.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from dopt.errors import IncompatibleError, SpecificationError
from dopt.registry import name_of
from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec

TRIAL_SECTIONS = (
    *("env", "plant", "policy", "model", "learner"),
    *("task", "limits", "assess", "seed"),
)
"""Sections of a configuration that define a trial."""


@dataclasses.dataclass(frozen=True)
class Combination:
    """Settings of one configuration of a grid, in plain types.

    Attributes
    ----------
    settings
        Sections of the resolved configuration.
    seeds
        Seeds of the configuration, or None for the one in ``settings``.
    overrides
        Swept overrides of this combination, as they would be typed.
    used, unused
        Keys set by the grid that exist in this choice of groups, and keys that do not.
    """

    settings: Mapping[str, Any]
    seeds: Sequence[Any] | None = None
    overrides: tuple[str, ...] = ()
    used: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Grid:
    """Distinct trials of a launch, with the trials that were left out.

    Attributes
    ----------
    trials
        In the order of execution: all configurations with their first seed, then the second, ...
    n_jobs
        Number of jobs of the command line, including repeats and left-out ones.
    left_out
        Number of left-out trials by reason.
    notes
        Message for each override that applies to a part of the grid only.
    """

    trials: list[TrialSpec]
    n_jobs: int
    left_out: dict[str, int]
    notes: tuple[str, ...] = ()

    @property
    def repeats(self) -> int:
        """Number of jobs that repeat a trial."""
        return self.n_jobs - sum(self.left_out.values()) - len(self.trials)

    def on_path(self, path: str) -> Grid:
        """Return the grid with its trials on an execution path."""
        configs: dict[str, TrialConfig] = {}
        trials = []
        for trial in self.trials:
            key = trial.config_key
            if key not in configs:
                configs[key] = dataclasses.replace(trial.config, path=path)
            trials.append(TrialSpec(configs[key], trial.seed))
        return dataclasses.replace(self, trials=trials)


def build_grid(combinations: Iterable[Combination], *, single: bool = False) -> Grid:
    """Return the grid of typed trials; incompatible choices are left out.

    For a ``single`` trial an incompatible choice is an error.

    Raises
    ------
    SpecificationError
        If a value is unknown, of the wrong type or out of bounds, or if nothing is left.
    """
    combinations = list(combinations)
    by_config: list[list[TrialSpec]] = []
    left_out: dict[str, int] = {}
    n_jobs = 0
    for combination in combinations:
        size = 1 if combination.seeds is None else len(combination.seeds)
        n_jobs += size
        try:
            by_config.append(_trials(combination))
        except IncompatibleError as error:
            if single:
                raise
            reason = f"{_choices(combination)}: {error}"
            left_out[reason] = left_out.get(reason, 0) + size
    trials = list({trial.trial_key: trial for trial in _seed_by_seed(by_config)}.values())
    if not trials:
        raise SpecificationError(
            f"the grid is empty: {' '.join(left_out) or 'no trial was requested'}"
        )
    return Grid(trials, n_jobs, left_out, tuple(_notes(combinations)))


def _notes(combinations: Sequence[Combination]) -> Iterator[str]:
    """Yield a message for each key that only some of the choices have."""
    for key in dict.fromkeys(key for one in combinations for key in one.unused):
        group = key.split(".")[0]
        having = (one.settings.get(group) for one in combinations if key in one.used)
        names = dict.fromkeys(name_of(part) for part in having if isinstance(part, Mapping))
        yield f"{key} applies to {group}={','.join(names)} only"


def _trials(combination: Combination) -> list[TrialSpec]:
    trial = TrialSpec.from_mapping(combination.settings)
    if combination.seeds is None:
        return [trial]
    return [trial.with_seed(seed) for seed in combination.seeds]


def _choices(combination: Combination) -> str:
    """Return the options of the groups, such as ``env=quadrotor policy=periodic``."""
    sections = combination.settings.items()
    return " ".join(f"{key}={name_of(part)}" for key, part in sections if key in ("env", "policy"))


def _seed_by_seed(by_config: Sequence[Sequence[TrialSpec]]) -> Iterator[TrialSpec]:
    for index in range(max(map(len, by_config), default=0)):
        yield from (trials[index] for trials in by_config if index < len(trials))
