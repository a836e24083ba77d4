"""Rows and arrays that a reader returns."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from orchestrate.store.records import Array
from orchestrate.store.schema import Outcome


@dataclass(frozen=True)
class ConfigRow:
    """Configuration with the counts of its trials.

    Attributes
    ----------
    width, depth
        Hidden layers of the model; None for a model without.
    horizon
        Steps T of each trial.
    dt
        Seconds between steps.
    gamma
        Bound of the input, in its unit.
    label
        The policy's title and what is not the default, such as ``D-optimal, γ=3``.
    config
        The whole configuration without the seed.
    """

    config_key: str
    env: str
    policy: str
    model: str
    learner: str
    width: int | None
    depth: int | None
    horizon: int
    dt: float
    gamma: float
    label: str
    n_done: int
    n_diverged: int
    n_failed: int
    n_cancelled: int
    n_pending: int
    n_running: int
    config: Mapping[str, Any]

    @property
    def n(self) -> int:
        """Registered trials."""
        finished = self.n_done + self.n_diverged + self.n_failed + self.n_cancelled
        return finished + self.n_pending + self.n_running


@dataclass(frozen=True)
class Curves:
    """Column of the steps of all n finished trials of a configuration.

    Attributes
    ----------
    seeds : (n,) int64, ascending
    t : (T,) int64
        To the horizon, or to the end of the longest exploration.
    values : (n, T) float64
        NaN from a divergence on, and after the end of an exploration.
    diverged : (n,) bool
    """

    seeds: npt.NDArray[np.int64]
    t: npt.NDArray[np.int64]
    values: Array
    diverged: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Assessments:
    """Measure of all n finished trials of a configuration, after k numbers of steps.

    Attributes
    ----------
    seeds : (n,) int64, ascending
    t : (k,) int64, ascending
    values : (n, k) float64, NaN where it is not finite or a trial diverged before that step
    diverged : (n,) bool
    """

    seeds: npt.NDArray[np.int64]
    t: npt.NDArray[np.int64]
    values: Array
    diverged: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class TrialRow(Outcome):
    """Summary of one trial; None for values that it does not have yet."""

    seed: int
    trial_key: str
    status: str
    attempt: int
    launch: int | None
    error_type: str | None
    error_message: str | None


@dataclass(frozen=True)
class LaunchRow:
    """Launch that wrote to the database, and whether its process is alive.

    Attributes
    ----------
    state
        State written by the launch; a killed one is "running" until another launch notices.
    started, ended
        UTC, as text.
    """

    launch_id: int
    state: str
    alive: bool
    started: str
    ended: str | None
    host: str
    pid: int
    argv: Sequence[str]
    overrides: Sequence[str]
    git_commit: str | None
    git_dirty: bool | None
    git_diff_hash: str | None
    versions: Mapping[str, str]
    fingerprint: Mapping[str, str] | None = None

    @property
    def kind(self) -> str:
        """Kind of command: a "worker", the "registration" of a grid for workers, or a "launch"."""
        if "work" in self.argv[1:2]:
            return "worker"
        return "registration" if "launch.detach=true" in self.overrides else "launch"


class Table(list[Any]):
    """Rows of a query as named tuples.

    ``columns`` are the names given by the database, also for an empty result. A name that is no
    Python identifier, such as ``count(*)``, is replaced by its position: ``_0``. ``cut`` is True if
    there were more rows than the limit of the query.
    """

    def __init__(
        self, columns: Iterable[str], rows: Iterable[Sequence[Any]], cut: bool = False
    ) -> None:
        self.columns = tuple(columns)
        self.cut = cut
        super().__init__(map(_row_type(self.columns)._make, rows))


@lru_cache(maxsize=256)
def _row_type(columns: tuple[str, ...]) -> Any:
    """Return the named tuple of some columns; making one takes longer than a short query."""
    return namedtuple("Row", columns, rename=True)


@dataclass(frozen=True)
class Trajectory:
    """States (T + 1, d), inputs (T, m) and final parameters (q,) of the model of one trial."""

    states: Array
    inputs: Array
    parameters: Array
