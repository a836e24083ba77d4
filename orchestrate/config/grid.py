"""From the combinations of a command line to the trials of a grid."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from dopt.cell import Cell
from dopt.errors import IncompatibleError, SpecificationError
from dopt.registry import name_of
from dopt.spec import TrialSpec

TRIAL_SECTIONS = ("env", "policy", "model", "learner", "task", "seed")
"""The parts of a configuration that make a trial."""


@dataclasses.dataclass(frozen=True)
class Combination:
    """Settings of one cell of a grid, in plain types.

    Attributes
    ----------
    settings
        Sections of the resolved configuration.
    inner
        Seeds of the cell, or None for the one in ``settings``.
    words
        The swept overrides that made it, as they would be typed.
    used, unused
        Keys that its grid sets: those that these choices have, and those that they lack.
    """

    settings: Mapping[str, Any]
    inner: Sequence[Any] | None = None
    words: tuple[str, ...] = ()
    used: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Grid:
    """The distinct trials of a launch, and what became of the rest.

    Attributes
    ----------
    trials
        In the order in which they run: every cell with its first seed, then with its second ...
    asked
        Number of trials that the command line spans, repeats and left-out ones included.
    left_out
        Sentence for each reason to leave trials out, with their number.
    notes
        Sentence for each setting that does not hold for the whole grid.
    """

    trials: list[TrialSpec]
    asked: int
    left_out: dict[str, int]
    notes: tuple[str, ...] = ()

    @property
    def repeats(self) -> int:
        """Number of trials that the command line names more than once."""
        return self.asked - sum(self.left_out.values()) - len(self.trials)

    def on_path(self, path: str) -> Grid:
        """Return the grid with its trials on an execution path."""
        cells: dict[str, Cell] = {}
        trials = []
        for trial in self.trials:
            key = trial.config_key
            if key not in cells:
                cells[key] = dataclasses.replace(trial.cell, path=path)
            trials.append(TrialSpec(cells[key], trial.seed))
        return dataclasses.replace(self, trials=trials)


def build_grid(combinations: Iterable[Combination], *, alone: bool = False) -> Grid:
    """Return the typed trials; pairs of choices that make no sense together are left out.

    ``alone`` says that a single trial was asked for, and such a pair is an error then.

    Raises
    ------
    SpecificationError
        If a value is unknown, of the wrong type or out of bounds, or if nothing is left.
    """
    combinations = list(combinations)
    cells: list[list[TrialSpec]] = []
    left_out: dict[str, int] = {}
    asked = 0
    for combination in combinations:
        size = 1 if combination.inner is None else len(combination.inner)
        asked += size
        try:
            cells.append(_trials(combination))
        except IncompatibleError as error:
            if alone:
                raise
            reason = f"{_choices(combination)}: {error}"
            left_out[reason] = left_out.get(reason, 0) + size
    trials = list({trial.trial_key: trial for trial in _seed_by_seed(cells)}.values())
    if not trials:
        raise SpecificationError(f"the grid is empty: {' '.join(left_out) or 'nothing was asked'}")
    return Grid(trials, asked, left_out, tuple(_notes(combinations)))


def _notes(combinations: Sequence[Combination]) -> Iterator[str]:
    """Yield for each key that some choices lack, which of them have it."""
    for key in dict.fromkeys(key for one in combinations for key in one.unused):
        group = key.split(".")[0]
        having = (one.settings.get(group) for one in combinations if key in one.used)
        names = dict.fromkeys(name_of(part) for part in having if isinstance(part, Mapping))
        yield f"{key} applies to {group}={','.join(names)} only"


def _trials(combination: Combination) -> list[TrialSpec]:
    trial = TrialSpec.from_mapping(combination.settings)
    if combination.inner is None:
        return [trial]
    return [trial.with_seed(seed) for seed in combination.inner]


def _choices(combination: Combination) -> str:
    """Return the options of the groups, such as ``env=quadrotor policy=periodic``."""
    sections = combination.settings.items()
    return " ".join(f"{key}={name_of(part)}" for key, part in sections if key in ("env", "policy"))


def _seed_by_seed(cells: Sequence[Sequence[TrialSpec]]) -> Iterator[TrialSpec]:
    for index in range(max(map(len, cells), default=0)):
        yield from (cell[index] for cell in cells if index < len(cell))
