"""Values that a launch passes to the results database, their form in it, and what a reader returns.

The drivers accept no NumPy scalars, NaN, local times or text with zero bytes. Arrays are stored as
little-endian bytes in row-major order, with their type and shape.
"""

from __future__ import annotations

import json
import math
from collections import namedtuple
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from sqlalchemy import Case, ColumnElement, case

from orchestrate.store.errors import StoreError
from orchestrate.store.schema import Outcome

Array = npt.NDArray[np.float64]


class Registrable(Protocol):
    """Trial before it runs, such as :class:`dopt.spec.trial.TrialSpec`."""

    @property
    def trial_key(self) -> str: ...
    @property
    def config_key(self) -> str: ...
    @property
    def config_json(self) -> str: ...
    @property
    def seed(self) -> int: ...
    def columns(self) -> Mapping[str, Any]:
        """Values of env, policy, model, learner, width, depth, horizon, dt, gamma and label."""


class Measured(Protocol):
    """Measure of a trial after t steps."""

    @property
    def t(self) -> int: ...
    @property
    def measure(self) -> str: ...
    @property
    def value(self) -> float: ...


class Result(Protocol):
    """Result of a trial; :class:`dopt.result.TrialResult` describes the fields."""

    @property
    def loss(self) -> Array: ...
    @property
    def reachable_loss(self) -> Array: ...
    @property
    def plan_us(self) -> Array: ...
    @property
    def learn_us(self) -> Array: ...
    @property
    def evaluate_us(self) -> Array: ...
    @property
    def states(self) -> Array: ...
    @property
    def inputs(self) -> Array: ...
    @property
    def parameters(self) -> Array: ...
    @property
    def diverged_at(self) -> int | None: ...
    @property
    def n_steps(self) -> int: ...
    @property
    def final_loss(self) -> float | None: ...
    @property
    def best_loss(self) -> float | None: ...
    @property
    def assessments(self) -> Sequence[Measured]: ...


@dataclass(frozen=True)
class LaunchRecord:
    """Provenance of one launch.

    Attributes
    ----------
    argv, overrides
        The command line, and its overrides.
    git_commit, git_dirty, git_diff_hash
        Commit of the code, whether the working tree differs from it, and the hash of the
        difference; None outside a repository.
    versions
        Version of the interpreter and of each library that can change a number.
    fingerprint
        Digests of the code, and versions, with which alone a worker runs what this launch registers
        (:func:`orchestrate.fingerprint.fingerprint`); None if unknown.
    """

    argv: Sequence[str]
    overrides: Sequence[str]
    host: str
    pid: int
    git_commit: str | None = None
    git_dirty: bool | None = None
    git_diff_hash: str | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    fingerprint: Mapping[str, str] | None = None


@dataclass(frozen=True)
class Claim:
    """Right of one launch to write the outcome of one attempt at one trial."""

    trial_key: str
    trial_id: int
    attempt: int
    launch: int


@dataclass(frozen=True)
class Registration:
    """State of a grid at its registration.

    Attributes
    ----------
    total
        Distinct trials of the grid: the sum of the other numbers and of ``len(todo)``.
    todo
        Keys of the trials to run, in the given order.
    """

    total: int
    done: int
    diverged: int
    failed: int
    cancelled: int
    running_elsewhere: int
    todo: list[str]


DTYPE = "<f8"


def plain(value: Any) -> Any:
    """Return a NumPy scalar as a Python number; sqlite3 would store its bytes."""
    return value.item() if isinstance(value, np.generic) else value


def finite(value: float | None) -> float | None:
    """Return the number, or None where it is not finite."""
    return float(value) if value is not None and math.isfinite(value) else None


def finite_list(array: Array) -> list[float | None]:
    """Return the numbers of a vector, with None for those that are not finite."""
    numbers: list[float | None] = array.tolist()
    if np.isfinite(array).all():
        return numbers
    return [finite(number) for number in numbers]


def storable(text: str) -> str:
    """Return the text with zero bytes and lone surrogates escaped, which databases reject."""
    return text.encode(errors="backslashreplace").decode().replace("\0", r"\x00")


def utc_text(moment: datetime) -> str:
    """Return UTC text of fixed width, which sorts by time; raise ValueError without a time zone."""
    if moment.tzinfo is None:
        raise ValueError(f"The time {moment.isoformat()} has no time zone: give one, such as UTC.")
    return moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def now() -> str:
    return utc_text(datetime.now(UTC))


def not_before(column: ColumnElement[str], moment: Any) -> Case[str]:
    """Return a time for SQL that is not before the one in the column, however clocks differ."""
    return case((column > moment, column), else_=moment)


def pack(array: Array) -> tuple[str, bytes]:
    """Return the shape as JSON and the numbers as bytes of type ``DTYPE``."""
    return json.dumps(array.shape), np.ascontiguousarray(array, dtype=DTYPE).tobytes()


def stacked(arrays: Sequence[Array]) -> Array:
    """Return arrays (T_i, k) as one, (n, T, k), with NaN after the end of the shorter ones."""
    longest = max(len(one) for one in arrays)
    result = np.full((len(arrays), longest, *arrays[0].shape[1:]), np.nan)
    for row, one in zip(result, arrays, strict=True):
        row[: len(one)] = one
    return result


def unpack(dtype: str, shape: str, data: bytes) -> Array:
    """Return the packed array in native byte order, writable; raise ``StoreError`` without one."""
    try:
        numbers = np.frombuffer(data, dtype=dtype).reshape(stored_json(shape, list))
        return numbers.astype(np.float64)
    except (ValueError, TypeError) as error:
        raise StoreError(f"An array of the database is damaged ({error}): {_RESTORE}.") from error


def stored_json(text: str, kind: type) -> Any:
    """Return the list or dict of a stored text; raise ``StoreError`` if it holds none."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        found = error
    if isinstance(found, kind):
        return found
    raise StoreError(f"The database holds {text[:40]!r} in the place of JSON: {_RESTORE}.")


_RESTORE = "it was changed by hand, so restore a copy, or give another database"


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
