"""Values that a launch passes to the results database, their form in it, and what a reader returns.

The drivers accept no NumPy scalars, NaN, local times or text with zero bytes. Arrays are stored as
little-endian bytes in row-major order, with their type and shape.

The table ``curve`` holds each column of the steps of a finished trial once more, as one packed
array: it is read many times faster than a row for each step. Where a row is missing, the curve is
read from its steps. A row counts for the attempt that it was written for, so that none is taken for
the curve of a later run. Each array ends with a checksum, as neither database notices a change
within one.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import zlib
from collections import namedtuple
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal
from functools import lru_cache
from typing import Any

import numpy as np
from sqlalchemy import (
    Case,
    ColumnElement,
    Connection,
    Select,
    and_,
    bindparam,
    case,
    delete,
    insert,
    select,
    text,
)

from dopt.types import Array, Booleans, Integers
from orchestrate.errors import StoreError, StoreUnavailableError
from orchestrate.store.backend import Backend
from orchestrate.store.schema import FINISHED, N_ROWS, STEP_VALUES, Outcome, curve, step, trial


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


def config_key(config_json: str) -> str:
    """Return the key of a configuration."""
    return hashlib.sha256(config_json.encode()).hexdigest()


def trial_key(config_json: str, seed: int) -> str:
    """Return the key of a trial as :class:`dopt.spec.trial.TrialSpec` makes it."""
    return config_key(f'{config_json[:-1]},"seed":{seed}}}')


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


def jsonable(value: Any) -> Any:
    """Return the value in the types of JSON."""
    if isinstance(value, Mapping):
        return {str(key): jsonable(one) for key, one in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return jsonable(value.tolist())
    if isinstance(value, list | tuple):
        return [jsonable(one) for one in value]
    if isinstance(value, Decimal):
        return int(value) if value == value.to_integral_value() else jsonable(float(value))
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, bytes | memoryview):
        return base64.b64encode(value).decode()
    return value if isinstance(value, bool | int | str | None) else str(value)


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


STATES = ("done", "diverged", "failed", "cancelled", "running", "pending")
"""Statuses of a trial in the order of display."""


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
    def counts(self) -> dict[str, int]:
        """Number of trials in each state, in the order of display."""
        return {state: getattr(self, f"n_{state}") for state in STATES}

    @property
    def n(self) -> int:
        """Registered trials."""
        return sum(self.counts.values())


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

    seeds: Integers
    t: Integers
    values: Array
    diverged: Booleans


class Assessments(Curves):
    """Measure of all n finished trials of a configuration, after k numbers of steps.

    Attributes
    ----------
    seeds : (n,) int64, ascending
    t : (k,) int64, ascending
    values : (n, k) float64, NaN where it is not finite or a trial diverged before that step
    diverged : (n,) bool
    """


@dataclass(frozen=True)
class TrialRow(Outcome):
    """Summary of one trial; None for values that it does not have yet."""

    seed: int
    trial_key: str
    status: str
    attempt: int
    launch_id: int | None
    error_type: str | None
    error_message: str | None


@dataclass(frozen=True, kw_only=True)
class LaunchRow(LaunchRecord):
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


def unpacked_trajectory(dtype: str, *packed: Any) -> Trajectory:
    """Return the arrays of a row: the type, and the shape and the bytes of each array."""
    return Trajectory(*(unpack(dtype, *packed[i : i + 2]) for i in (0, 2, 4)))


PAGE = 200
"""Trials in one transaction, so that a launch waits for less than a second."""

_CHECK_BYTES = 4
_DELETE = delete(curve).where(curve.c.trial_id == bindparam("earlier"))
_INSERT = insert(curve)
_STEPS = select(*(step.c[name] for name in STEP_VALUES)).order_by(step.c.t)
CURRENT = and_(curve.c.trial_id == trial.c.trial_id, curve.c.attempt == trial.c.attempt)
"""Condition that a row is the curve of a trial as it is now."""


def write_curves(connection: Connection, curves: Iterable[tuple[int, int, Array]]) -> None:
    """Write curves in place of earlier ones: trial_id, attempt, (T, number of STEP_VALUES)."""
    rows = [
        {
            "trial_id": trial_id,
            "attempt": attempt,
            **{name: _packed(steps[:, i]) for i, name in enumerate(STEP_VALUES)},
        }
        for trial_id, attempt, steps in curves
    ]
    if rows:
        connection.execute(_DELETE, [{"earlier": row["trial_id"]} for row in rows])
        connection.execute(_INSERT, rows)


def write_missing_curves(backend: Backend) -> int:
    """Write the curves that finished trials lack, and return their number."""
    written = last = 0
    while True:
        with backend.transaction() as connection:
            rows = connection.execute(_missing(last)).all()
            for row in rows:  # one by one, as a curve may be long
                steps = connection.execute(_STEPS.where(step.c.trial_id == row.trial_id)).all()
                numbers = np.array(list(map(tuple, steps)), np.float64)
                write_curves(connection, [(row.trial_id, row.attempt, numbers)])
        if not rows:
            return written
        written, last = written + len(rows), rows[-1].trial_id


def _missing(last: int) -> Select[tuple[int, int]]:
    return (
        select(trial.c.trial_id, trial.c.attempt)
        .outerjoin(curve, CURRENT)
        .where(trial.c.trial_id > last, trial.c.status.in_(FINISHED), curve.c.trial_id.is_(None))
        .order_by(trial.c.trial_id)
        .limit(PAGE)
        .with_for_update(of=trial)
    )


def _packed(column: Array) -> bytes:
    data = np.ascontiguousarray(column, dtype=DTYPE).tobytes()
    return data + _checksum(data)


def unpacked_curve(packed: bytes) -> Array:
    """Return the numbers of an array (T,); none if it is damaged."""
    data = packed[:-_CHECK_BYTES]
    return np.frombuffer(data if _checksum(data) == packed[-_CHECK_BYTES:] else b"", DTYPE)


def _checksum(data: bytes) -> bytes:
    return zlib.crc32(data).to_bytes(_CHECK_BYTES, "little")


_TRIALS = (
    f"SELECT r.trial_id, r.seed, r.status, {N_ROWS} AS n, p.{{column}} AS packed FROM trial r "
    "JOIN config c ON c.config_id = r.config_id "
    "LEFT JOIN curve p ON p.trial_id = r.trial_id AND p.attempt = r.attempt "
    "WHERE c.config_id = :config_id AND r.status IN ('done', 'diverged') ORDER BY r.seed"
)


def read_curves(
    connection: Connection, config_id: int, horizon: int, column: str, place: str
) -> Curves:
    """Return a column of the steps of all finished trials of a configuration.

    Raises ``StoreUnavailableError`` if a step is missing; ``place`` names the configuration.
    """
    statement = text(_TRIALS.format(column=column))
    trials = connection.execute(statement, {"config_id": config_id}).all()
    parts = [
        _of_steps(connection, row.trial_id, row.n, column)
        if row.packed is None
        else unpacked_curve(row.packed)
        for row in trials
    ]
    lengths = np.array([row.n for row in trials], dtype=np.int64)
    found = [len(part) for part in parts]
    if found != lengths.tolist():
        raise StoreUnavailableError(
            f"The curves of {place} are incomplete ({sum(found):,} steps instead of "
            f"{lengths.sum():,}): the database is damaged; run python -m orchestrate doctor."
        )
    t = np.arange(lengths.max(initial=0) if trials else horizon, dtype=np.int64)
    values = np.full((len(trials), len(t)), np.nan)
    values[t < lengths[:, None]] = np.concatenate([np.empty(0), *parts])
    return Curves(
        seeds=np.array([row.seed for row in trials], dtype=np.int64),
        t=t,
        values=values,
        diverged=np.array([row.status == "diverged" for row in trials], dtype=np.bool_),
    )


def _of_steps(connection: Connection, trial_id: int, n: int, column: str) -> Array:
    """Return a column of the first n steps of a trial without a packed curve, NULL as NaN."""
    first = (step.c.trial_id == trial_id) & step.c.t.between(0, n - 1)
    numbers = connection.execute(select(step.c[column]).where(first).order_by(step.c.t))
    return np.array(numbers.scalars().all(), np.float64)
