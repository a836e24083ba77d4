"""Columns of steps as matrices: from packed curves, and from the steps of trials without one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Any, cast

import numpy as np
from sqlalchemy import Connection, CursorResult, Row, exists, select, text

from orchestrate.store import packed_curves
from orchestrate.store.errors import StoreUnavailableError
from orchestrate.store.read.rows import Curves
from orchestrate.store.records import Array
from orchestrate.store.schema import FINISHED, N_ROWS, curve, step, trial

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

    Those of a damaged array are none.
    """
    pieces = iter(np.split(stepwise, np.cumsum(rest)[:-1]))
    return [
        next(pieces) if row.packed is None else packed_curves.unpacked(row.packed) for row in trials
    ]


def _stepwise(connection: Connection, config_id: int, horizon: int, column: str) -> Array:
    """Return a column of the steps of the trials without a packed curve, NULL as NaN."""
    packed = exists().where(packed_curves.CURRENT).correlate(trial).select_from(curve)
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
