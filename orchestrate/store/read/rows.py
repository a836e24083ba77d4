"""What a reader of the database gets."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from orchestrate.store.records import Array


@dataclass(frozen=True)
class Cell:
    """One configuration of the grid and how far its trials are.

    Attributes
    ----------
    width, depth
        Hidden layers of the model; None where the model has none.
    horizon
        Steps T of each trial.
    dt
        Seconds between steps.
    gamma
        Bound of the input, in the input's unit.
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
    """One column of the steps of all n finished trials of a configuration.

    Attributes
    ----------
    seeds : (n,) int64, ascending
    t : (T,) int64
    values : (n, T) float64, NaN from a divergence on
    diverged : (n,) bool
    """

    seeds: npt.NDArray[np.int64]
    t: npt.NDArray[np.int64]
    values: Array
    diverged: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Assessments:
    """One measure of all n finished trials of a configuration, after k numbers of steps.

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
class TrialRow:
    """Summary of one trial; None where it has not got that far."""

    seed: int
    trial_key: str
    status: str
    attempt: int
    n_steps: int | None
    diverged_at: int | None
    final_loss: float | None
    best_loss: float | None
    wall_seconds: float | None
    cpu_seconds: float | None
    peak_memory_bytes: int | None
    node: str | None
    launch: int | None
    error_type: str | None
    error_message: str | None


@dataclass(frozen=True)
class LaunchRow:
    """One command that wrote to the database, and whether its process lives.

    Attributes
    ----------
    state
        As the launch wrote it; one that was killed says "running" until another one notices.
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


class Table(list[Any]):
    """Rows of a query, each a tuple that knows its columns by name too.

    ``columns`` are the names as the database gave them, also where there is no row. In a row, a
    name that Python cannot use, such as ``count(*)``, is its place with an underscore: ``_0``.
    ``cut`` says that there were more rows than the limit of the query.
    """

    def __init__(
        self, columns: Iterable[str], rows: Iterable[Sequence[Any]], cut: bool = False
    ) -> None:
        self.columns = tuple(columns)
        self.cut = cut
        row_type = namedtuple("Row", self.columns, rename=True)  # type: ignore[misc]
        super().__init__(map(row_type._make, rows))


@dataclass(frozen=True)
class Trajectory:
    """States (T + 1, d), inputs (T, m) and final parameters (q,) of the model of one trial."""

    states: Array
    inputs: Array
    parameters: Array
