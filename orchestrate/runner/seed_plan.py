"""Stages of a launch: the whole grid, or its seeds in batches until a rule needs no more."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence

from dopt.stopping.looks import looks
from orchestrate.config.grid import Grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.config.stopping_rule import UntilPrecise
from orchestrate.runner.seed_rule import Losses, SeedRule, by_config
from orchestrate.runner.text_table import aligned
from orchestrate.runner.until_decided import DecidedComparisons
from orchestrate.runner.until_precise import PreciseMeans

FinalLosses = Callable[[Sequence[str]], Losses]
"""Function that returns the final losses of the trials with some keys."""


class SeedPlan:
    """Trials that a launch wants, stage after stage.

    Without a rule the only stage is the grid. With one, each stage has all trials of the stage
    before and the next seeds of the configurations that need more: the plan of an interrupted
    launch passes through the same stages again.

    Raises
    ------
    LaunchError
        If the rule does not apply to the grid.
    """

    def __init__(self, grid: Grid, settings: LaunchSettings) -> None:
        self._grid = grid
        self._rule = _rule(grid, settings)
        self._seeds = by_config(grid.trials)
        self._used = dict.fromkeys(self._seeds, 0)

    @property
    def adaptive(self) -> bool:
        """Whether a rule decides how many seeds are run."""
        return self._rule is not None

    def stages(self, final_losses: FinalLosses) -> Iterator[tuple[str, Grid]]:
        """Yield a heading and a grid; all its trials have an outcome when the next one is asked."""
        if self._rule is None:
            yield "", self._grid
            return
        maximum = max(map(len, self._seeds.values()))
        for n, wanting in self._looks(self._rule, maximum):
            self._used |= {key: min(n, len(self._seeds[key])) for key in wanting}
            stage = self._stage(first=n == looks(maximum)[0])
            yield f"{len(wanting):,} configurations, up to {n} of {maximum} seeds: ", stage
            self._rule.look(n, final_losses([trial.trial_key for trial in stage.trials]))

    def report(self) -> str:
        """Return for each configuration the number of its seeds and what the rule found."""
        assert self._rule is not None, "only a rule has something to report"
        lines = [["env", "configuration", "seeds", "result"]]
        for key, trials in self._seeds.items():
            columns = trials[0].columns()
            names = [str(columns["env"]), str(columns["label"])]
            lines.append([*names, str(self._used[key]), self._rule.result(key)])
        used, total = sum(self._used.values()), len(self._grid.trials)
        share = f"{used:,} of {total:,} trials ({100 * used / total:.0f} %)"
        return "\n".join([*aligned(lines), f"{share}, {self._rule.summary()}"])

    @staticmethod
    def _looks(rule: SeedRule, maximum: int) -> Iterator[tuple[int, set[str]]]:
        """Yield the looks until no configuration needs more seeds, with those that do."""
        before = 0
        for n in looks(maximum):
            wanting = rule.wanting(before)
            if not wanting:
                return
            yield n, wanting
            before = n

    def _stage(self, *, first: bool) -> Grid:
        places = dict.fromkeys(self._seeds, 0)
        trials = []
        for trial in self._grid.trials:
            places[trial.config_key] += 1
            if places[trial.config_key] <= self._used[trial.config_key]:
                trials.append(trial)
        left_out = self._grid.left_out if first else {}
        n_jobs = len(trials) + sum(left_out.values()) + (self._grid.repeats if first else 0)
        return dataclasses.replace(self._grid, trials=trials, left_out=left_out, n_jobs=n_jobs)


def _rule(grid: Grid, settings: LaunchSettings) -> SeedRule | None:
    if settings.until is None:
        return None
    seeds = by_config(grid.trials)
    if isinstance(settings.until, UntilPrecise):
        return PreciseMeans(seeds, settings.until.relative)
    return DecidedComparisons(seeds, settings.reference)
