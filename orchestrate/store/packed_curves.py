"""Packed curves: each column of the steps of a finished trial once more, as one array.

A column of numbers is read from arrays many times faster than from a row for each step. Where a row
is missing, the curve is read from its steps. A row counts for the attempt that it was written for,
so that none is taken for the curve of a later run. Each array ends with a checksum, as neither
database notices a change within one.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable

import numpy as np
from sqlalchemy import Connection, Select, and_, bindparam, delete, insert, select

from orchestrate.store.backends.base import Backend
from orchestrate.store.records import Array
from orchestrate.store.schema import FINISHED, STEP_VALUES, curve, step, trial
from orchestrate.store.serialization import DTYPE

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
