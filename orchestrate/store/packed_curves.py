"""Packed curves: each column of the steps of a finished trial once more, as one array.

A column of numbers is read from arrays many times faster than from a row for each step. Where a row
is missing, the curve is read from its steps. A row counts for the attempt that it was written for,
so that none is taken for the curve of a later run. Each array ends with a checksum, as neither
database notices a change within one.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Any, cast

import numpy as np
from sqlalchemy import (
    Connection,
    CursorResult,
    Row,
    Select,
    and_,
    bindparam,
    delete,
    exists,
    insert,
    select,
    text,
)

from orchestrate.store.backends.base import Backend
from orchestrate.store.errors import StoreUnavailableError
from orchestrate.store.records import DTYPE, Array, Curves
from orchestrate.store.schema import FINISHED, N_ROWS, STEP_VALUES, curve, step, trial

PAGE = 200
"""Trials in one transaction, so that a launch waits for less than a second."""

_CHECK_BYTES = 4
_DELETE = delete(curve).where(curve.c.trial_id == bindparam("earlier"))
_INSERT = insert(curve)
_STEPS = select(*(step.c[name] for name in STEP_VALUES)).order_by(step.c.t)
CURRENT = and_(curve.c.trial_id == trial.c.trial_id, curve.c.attempt == trial.c.attempt)
"""Condition that a row is the curve of a trial as it is now."""


def write(connection: Connection, curves: Iterable[tuple[int, int, Array]]) -> None:
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


def write_missing(backend: Backend) -> int:
    """Write the curves that finished trials lack, and return their number."""
    written = last = 0
    while True:
        with backend.transaction() as connection:
            rows = connection.execute(_missing(last)).all()
            for row in rows:  # one by one, as a curve may be long
                steps = connection.execute(_STEPS.where(step.c.trial_id == row.trial_id)).all()
                numbers = np.array(list(map(tuple, steps)), np.float64)
                write(connection, [(row.trial_id, row.attempt, numbers)])
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


def unpacked(packed: bytes) -> Array:
    """Return the numbers of an array (T,); none if it is damaged."""
    data = packed[:-_CHECK_BYTES]
    return np.frombuffer(data if _checksum(data) == packed[-_CHECK_BYTES:] else b"", DTYPE)


def _checksum(data: bytes) -> bytes:
    return zlib.crc32(data).to_bytes(_CHECK_BYTES, "little")


_TRIALS = (
    f"SELECT r.seed, r.status, {N_ROWS} AS n, p.{{column}} AS packed FROM trial r "
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
    rest = [row.n for row in trials if row.packed is None]
    stepwise = _stepwise(connection, config_id, horizon, column) if rest else _NONE
    parts = _parts(trials, stepwise, rest)
    lengths = np.array([row.n for row in trials], dtype=np.int64)
    found = sum(map(len, parts))
    if stepwise.size != sum(rest) or found != lengths.sum():
        raise StoreUnavailableError(
            f"The curves of {place} are incomplete ({found:,} steps instead of "
            f"{lengths.sum():,}): the database is damaged; run python -m orchestrate doctor."
        )
    t = np.arange(lengths.max(initial=0) if trials else horizon, dtype=np.int64)
    values = np.full((len(trials), len(t)), np.nan)
    values[t < lengths[:, None]] = np.concatenate([_NONE, *parts])
    return Curves(
        seeds=np.array([row.seed for row in trials], dtype=np.int64),
        t=t,
        values=values,
        diverged=np.array([row.status == "diverged" for row in trials], dtype=np.bool_),
    )


_NONE: Array = np.empty(0)


def _parts(trials: Sequence[Row[Any]], stepwise: Array, rest: Sequence[int]) -> list[Array]:
    """Return the numbers of each trial: those that are not packed are taken from ``stepwise``.

    A damaged array gives an empty one.
    """
    pieces = iter(np.split(stepwise, np.cumsum(rest)[:-1]))
    return [next(pieces) if row.packed is None else unpacked(row.packed) for row in trials]


def _stepwise(connection: Connection, config_id: int, horizon: int, column: str) -> Array:
    """Return a column of the steps of the trials without a packed curve, NULL as NaN."""
    packed = exists().where(CURRENT).correlate(trial).select_from(curve)
    finished = (trial.c.config_id == config_id) & trial.c.status.in_(FINISHED)
    statement = (
        select(step.c[column])
        .join(trial, trial.c.trial_id == step.c.trial_id)
        .where(finished, ~packed, step.c.t.between(0, horizon - 1))
        .order_by(trial.c.seed, step.c.t)
    )
    return _numbers(connection.execute(statement))


def _numbers(result: CursorResult[Any]) -> Array:
    """Return the only column of a result, NULL as NaN.

    The driver's cursor is read directly, because a SQLAlchemy row for each number doubles the time.
    """
    rows = cast("Iterable[tuple[float | None]]", result.cursor)
    return np.fromiter(chain.from_iterable(rows), np.float64)
