"""Seeds as needed: the stages of ``launch.until``, and when a mean is known.

A configuration gets no more seeds once the interval of the geometric mean of its final loss is
narrow. Such a rule stops too early where the spread is underestimated (Y. Chow and H. Robbins, "On
the asymptotic theory of fixed-width sequential confidence intervals for the mean", 1965): Student's
interval of 95 %, with a first look after ten seeds, covers the mean of normal values in 93.4 % of
simulated studies, and the mean of skewed ones in 92 %. The interval here is Student's of 98 %, with
no stop before 20 seeds.
``python -m studies.adaptive_seeds.coverage`` simulates its coverage.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from tabulate import tabulate

from dopt.errors import counted
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from orchestrate.config import Grid

FinalLosses = Callable[[Sequence[str]], Mapping[str, float]]
"""Function that returns the final loss of each trial that is done and did not diverge."""

STUDENT_CONFIDENCE = 0.98
"""Level of Student's interval that covers at least 95 % after stopping."""

FEWEST_VALUES = 20
"""Values before which the spread is not trusted."""

FEWEST_SEEDS = 10
"""Fewest seeds between two looks."""

MOST_LOOKS = 20


def looks(maximum: int) -> list[int]:
    """Return the numbers of seeds at which results are looked at, the last one the maximum.

    They are multiples of ten seeds, or of the smallest multiple of ten that gives at most twenty.
    """
    step = FEWEST_SEEDS * -(-maximum // (FEWEST_SEEDS * MOST_LOOKS))
    return [*range(step, maximum, step), maximum]


def half_width(losses: Array) -> float:
    """Return half the width of the interval of the mean log of losses (n,).

    The geometric mean is in the interval exp(mean ± half width), in at least 95 % of studies that
    stop by :func:`is_narrow`. NaN where a loss is not positive and finite, or there are fewer
    than two.
    """
    from scipy.special import stdtrit  # scipy.stats takes longer to import

    if len(losses) < 2 or not np.all(np.isfinite(losses) & (losses > 0)):
        return float("nan")
    quantile = stdtrit(len(losses) - 1, 0.5 + STUDENT_CONFIDENCE / 2)
    return float(quantile * np.std(np.log(losses), ddof=1) / np.sqrt(len(losses)))


def is_narrow(losses: Array, relative: float) -> bool:
    """Return whether the geometric mean of losses (n,) is known to within 1 + ``relative``."""
    enough = len(losses) >= FEWEST_VALUES
    return enough and bool(half_width(losses) <= np.log1p(relative))


class SeedPlan:
    """Trials that a launch wants, stage after stage.

    Without a precision the only stage is the grid. With one, each stage has all trials of the stage
    before and the next seeds of the configurations whose mean is not known: the plan of an
    interrupted launch passes through the same stages again, since it is a function of the losses
    in the order of the seeds alone.

    Parameters
    ----------
    grid
        Trials of the launch.
    relative
        Precision of the geometric means, as a share of them; None for all seeds.
    """

    def __init__(self, grid: Grid, relative: float | None) -> None:
        self._grid = grid
        self._relative = relative
        self._seeds: dict[str, list[TrialSpec]] = {}
        for trial in grid.trials:
            self._seeds.setdefault(trial.config_key, []).append(trial)
        self._used = dict.fromkeys(self._seeds, 0)
        self._losses = {key: np.array([]) for key in self._seeds}
        self._known: set[str] = set()

    @property
    def adaptive(self) -> bool:
        """Return whether the results decide how many seeds are run."""
        return self._relative is not None

    def stages(self, final_losses: FinalLosses) -> Iterator[tuple[str, Grid]]:
        """Yield a heading and a grid; all its trials have an outcome when the next one is asked."""
        if self._relative is None:
            yield "", self._grid
            return
        numbers = looks(max(map(len, self._seeds.values())))
        for before, n in zip([0, *numbers], numbers, strict=False):
            wanting = {key for key, all_ in self._seeds.items() if len(all_) > before} - self._known
            if not wanting:
                return
            self._used |= {key: min(n, len(self._seeds[key])) for key in wanting}
            stage = self._stage(first=before == 0)
            counts = counted(len(wanting), "configuration")
            yield f"{counts}, up to {n} of {numbers[-1]} seeds: ", stage
            self._look(n, self._relative, final_losses([one.trial_key for one in stage.trials]))

    def report(self) -> str:
        """Return for each configuration the number of its seeds and what is known of its mean."""
        lines = [["env", "configuration", "seeds", "result"]]
        for key, trials in self._seeds.items():
            columns = trials[0].columns()
            names = [str(columns["env"]), str(columns["label"])]
            lines.append([*names, str(self._used[key]), self._result(key)])
        used, total = sum(self._used.values()), len(self._grid.trials)
        share = f"{used:,} of {total:,} trials ({100 * used / total:.0f} %)"
        known = f"{len(self._known):,} of {len(self._seeds):,} means known"
        table = tabulate(lines, tablefmt="plain", disable_numparse=True)
        return f"{table}\n{share}, {known}"

    def _look(self, n: int, relative: float, losses: Mapping[str, float]) -> None:
        """Look at the losses of the first n seeds of the configurations that are not known."""
        for key in set(self._seeds) - self._known:
            found = (losses.get(trial.trial_key) for trial in self._seeds[key][:n])
            self._losses[key] = np.array([loss for loss in found if loss is not None])
            if is_narrow(self._losses[key], relative):
                self._known.add(key)

    def _result(self, config_key: str) -> str:
        losses = self._losses[config_key]
        half = half_width(losses)
        if math.isnan(half):
            return "mean unknown"
        mean = math.exp(float(np.mean(np.log(losses))))
        percent = 100 * math.expm1(half)
        found = f"mean {mean:.3g} ± {percent:{',.0f' if percent > 99 else '.2g'}} %"
        return f"{found}, known" if config_key in self._known else found

    def _stage(self, *, first: bool) -> Grid:
        places = dict.fromkeys(self._seeds, 0)
        trials = []
        for trial in self._grid.trials:
            places[trial.config_key] += 1
            if places[trial.config_key] <= self._used[trial.config_key]:
                trials.append(trial)
        left_out = self._grid.left_out if first else {}
        n_jobs = len(trials) + sum(left_out.values()) + (self._grid.repeats if first else 0)
        return replace(self._grid, trials=trials, left_out=left_out, n_jobs=n_jobs)
