"""Order of the trials of a launch: stages of seeds, and chunks for the workers; memory of trials.

With ``launch.until='ci<5%'`` a configuration gets no more seeds once the interval of the geometric
mean of its final loss is narrow. A rule that stops when an interval is narrow stops too early where
the spread is underestimated (Y. Chow and H. Robbins, "On the asymptotic theory of fixed-width
sequential confidence intervals for the mean", 1965): Student's interval of 95 %, with a first look
after ten seeds, covers the mean of normal values in 93.4 % of simulated studies, and the mean of
skewed ones in 92 %. The interval here is Student's of 98 %, with no stop before 20 seeds.
``python -m studies.adaptive_seeds.coverage`` simulates its coverage.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from tabulate import tabulate

from dopt.spec.trial import TrialSpec
from dopt.types import Array
from orchestrate.config import Grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.errors import LaunchError
from orchestrate.executors.base import Task
from orchestrate.executors.registry import executor_factory

MAX_CHUNK_TRIALS = 200
"""Largest number of trials in a chunk, which bounds the loss when a worker dies."""


class Chunks:
    """Queue of waiting trials, cut into chunks by the measured cost of their configurations.

    Parameters
    ----------
    trials
        In the order of execution.
    seconds
        Work in a chunk [s].
    slots
        Number of workers, which may change; chunks get smaller towards the end, so that all workers
        finish together.
    batch
        Chunk size in trials of one configuration; None cuts by cost.

    Attributes
    ----------
    pending
        Number of chunks that the workers hold; the scheduler keeps it up to date.
    lone_losses
        Losses of a whole machine while it ran one trial and the launch no other, by trial.
    """

    def __init__(
        self, trials: Iterable[TrialSpec], seconds: float, slots: int, batch: int | None = None
    ) -> None:
        self._batch = batch
        self._waiting: deque[TrialSpec] = deque()
        self._alone: deque[TrialSpec] = deque()
        self._exclusive: deque[TrialSpec] = deque()
        self._exclusive_runs = False
        self.pending = 0
        self.lone_losses: Counter[str] = Counter()
        self.add(trials)
        self._seconds = seconds
        self.slots = slots
        self._costs: dict[str, float] = {}

    def __len__(self) -> int:
        if self.pending and self._exclusive_runs:
            return 0
        return len(self._waiting) + len(self._alone) or (
            0 if self.pending else len(self._exclusive)
        )

    def add_exclusive(self, trials: Iterable[TrialSpec]) -> None:
        """Append trials that run last, and each while no other trial of the launch runs."""
        self._exclusive.extend(trials)

    def add(self, trials: Iterable[TrialSpec], *, alone: bool = False) -> None:
        """Append trials to the queue, each as a chunk of its own if ``alone``."""
        if self._batch:
            by_config: dict[str, list[TrialSpec]] = {}
            for trial in trials:
                by_config.setdefault(trial.config_key, []).append(trial)
            trials = itertools.chain.from_iterable(by_config.values())
        (self._alone if alone else self._waiting).extend(trials)

    def observe(self, config_key: str, seconds: float) -> None:
        """Update the mean cost of a configuration with a measured trial."""
        known = self._costs.get(config_key)
        self._costs[config_key] = seconds if known is None else 0.7 * known + 0.3 * seconds

    def next(self) -> list[Task]:
        """Return the next chunk; one trial while the cost of its configuration is unknown."""
        self._exclusive_runs = not (self._alone or self._waiting)
        for queue in (self._alone, self._exclusive if self._exclusive_runs else ()):
            if queue:
                trial = queue.popleft()
                return [Task(trial.trial_key, trial)]
        most = min(MAX_CHUNK_TRIALS, max(1, len(self._waiting) // (2 * self.slots)))
        chunk: list[Task] = []
        cost = 0.0
        while self._waiting and len(chunk) < (self._batch or most):
            key = self._waiting[0].config_key
            cost += self._costs.get(key, self._seconds)
            full = (
                chunk[0].spec.config_key != key if self._batch and chunk else cost > self._seconds
            )
            if chunk and full:
                break
            trial = self._waiting.popleft()
            chunk.append(Task(trial.trial_key, trial))
        return chunk


BYTES_PER_GIB = 2**30
CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


def check_memory(grid: Grid, settings: LaunchSettings, machine: int | None = None) -> None:
    """Refuse a grid whose trials need more memory than there is.

    Parameters
    ----------
    grid, settings
        Trials and settings of the launch. The memory of a cluster and of a GPU is not checked.
    machine
        Bytes of memory; None reads them from this machine.

    Raises
    ------
    LaunchError
        If one trial does not fit, or the trials that run at the same time do not.
    """
    if not grid.trials:
        return
    counts = Counter(trial.config_key for trial in grid.trials)
    configs = {trial.config_key: trial.config for trial in grid.trials}
    keys = sorted(configs, key=lambda key: configs[key].memory, reverse=True)
    largest = configs[keys[0]]
    name = f"a trial of env={largest.system.name} policy={largest.policy.name}"
    if settings.memory_gib is not None and largest.memory > settings.memory_gib * BYTES_PER_GIB:
        raise LaunchError(
            f"{name} needs {_gib(largest.memory)} of memory, but launch.memory_gib allows "
            f"{settings.memory_gib:g} GiB: raise it, or make {largest.largest_setting} smaller."
        )
    factory = executor_factory(settings)
    at_once = factory.trials_at_once(settings)
    if at_once is None:
        return
    available = memory_of_this_machine() if machine is None else machine
    if largest.memory > available:
        raise LaunchError(
            f"{name} needs {_gib(largest.memory)} of memory, but this machine has "
            f"{_gib(available)}: make {largest.largest_setting} smaller."
        )
    needs = [configs[key].memory for key in keys for _ in range(min(counts[key], at_once))]
    together = needs[:at_once]
    if sum(together) > available:
        raise LaunchError(
            f"{len(together)} trials at the same time need {_gib(sum(together))} of memory, but "
            f"this machine has {_gib(available)}: set {factory.limiting_key}="
            f"{available // largest.memory}."
        )


def memory_of_this_machine() -> int:
    """Return the bytes of memory that this process may use."""
    physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        return min(physical, int(CGROUP_LIMIT.read_text()))
    except (OSError, ValueError):  # not in a group, or in one without a limit
        return physical


def _gib(count: int) -> str:
    gib = count / BYTES_PER_GIB
    return f"{gib:,.3g} GiB" if gib < 1000 else f"{count >> 30:,} GiB"


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
        """Whether the results decide how many seeds are run."""
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
            yield f"{len(wanting):,} configurations, up to {n} of {numbers[-1]} seeds: ", stage
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
        found = f"mean {mean:.3g} ± {100 * math.expm1(half):.2g} %"
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
        return dataclasses.replace(self._grid, trials=trials, left_out=left_out, n_jobs=n_jobs)
