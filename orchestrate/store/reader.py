"""The read side of the results database; it never creates and cannot write."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import chain
from typing import Any, Self, cast

import numpy as np
from sqlalchemy import Connection, CursorResult, Engine, select, text

from orchestrate.store import address, postgresql, sqlite, versioning
from orchestrate.store.errors import QueryError
from orchestrate.store.faults import translated, translated_query
from orchestrate.store.packing import unpack
from orchestrate.store.records import Array
from orchestrate.store.rows import Cell, Curves, Table, Trajectory, TrialRow
from orchestrate.store.schema import STEP_VALUES, config, step, trajectory, trial

_CELLS = text(
    "SELECT p.config_key, p.env, p.policy, p.model, p.learner, p.width, p.depth, p.horizon, p.dt, "
    "p.gamma, p.n_done, p.n_diverged, p.n_failed, p.n_cancelled, p.n_pending, p.n_running, "
    "c.config_json "
    "FROM v_progress p JOIN config c ON c.config_key = p.config_key "
    "ORDER BY p.env, p.policy, p.model, p.learner, p.width, p.depth, p.config_key"
)
_TRIALS = text(
    "SELECT seed, trial_key, status, attempt, n_steps, diverged_at, final_loss, best_loss, "
    "wall_seconds, cpu_seconds, peak_memory_bytes, node, launch_id, error_type, error_message "
    "FROM v_trial WHERE config_key = :config_key ORDER BY seed"
)


class Reader:
    """A results database to read from; each method sees one moment of it.

    Every method raises ``StoreUnavailableError`` where the database itself fails.
    """

    def __init__(self, engine: Engine, safe_url: str) -> None:
        self._engine = engine
        self.safe_url = safe_url

    @classmethod
    def open(cls, url: str) -> Self:
        """Open a database; raise ``NoDatabaseError`` or ``SchemaVersionError`` where it cannot."""
        parsed = address.parse(url)
        kind = sqlite if parsed.get_backend_name() == "sqlite" else postgresql
        reader = cls(kind.read_engine(parsed), address.safe(parsed))
        try:
            reader.schema_version()
        except BaseException:
            reader.close()
            raise
        return reader

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give back the connections."""
        self._engine.dispose()

    def schema_version(self) -> str:
        """Return the version of the database's schema."""
        with self._snapshot() as connection:
            return str(versioning.check(connection, self.safe_url))

    def cells(self) -> list[Cell]:
        """Return every configuration, sorted by its names, with the state of its trials."""
        with self._snapshot() as connection:
            return [_cell(*row) for row in connection.execute(_CELLS)]

    def trials(self, config_key: str) -> list[TrialRow]:
        """Return the trials of a configuration by seed; none where it is unknown."""
        with self._snapshot() as connection:
            rows = connection.execute(_TRIALS, {"config_key": config_key})
            return [TrialRow(*row) for row in rows]

    def curves(self, config_key: str, column: str = "loss") -> Curves:
        """Return a column of the steps of all done and diverged trials of a configuration.

        Raises ``QueryError`` where the column or the configuration is unknown.
        """
        _check_column(column)
        with self._snapshot() as connection:
            config_id, horizon = _config(connection, config_key)
            finished = (trial.c.config_id == config_id) & trial.c.status.in_(("done", "diverged"))
            trials = connection.execute(
                select(trial.c.seed, trial.c.status).where(finished).order_by(trial.c.seed)
            ).all()
            rows = connection.execute(
                select(step.c[column])
                .join(trial, trial.c.trial_id == step.c.trial_id)
                .where(finished)
                .order_by(trial.c.seed, step.c.t)
            )
            numbers = _numbers(rows)
        return Curves(
            seeds=np.array([seed for seed, _ in trials], dtype=np.int64),
            t=np.arange(horizon, dtype=np.int64),
            values=numbers.reshape(len(trials), horizon),
            diverged=np.array([status == "diverged" for _, status in trials], dtype=np.bool_),
        )

    def trajectory(self, config_key: str, seed: int) -> Trajectory:
        """Return the arrays of one trial; raise ``QueryError`` where it has none."""
        names = ("states", "inputs", "parameters")
        columns = chain.from_iterable((trajectory.c[f"{n}_shape"], trajectory.c[n]) for n in names)
        statement = (
            select(trajectory.c.dtype, *columns)
            .join(trial, trial.c.trial_id == trajectory.c.trial_id)
            .join(config, config.c.config_id == trial.c.config_id)
            .where(config.c.config_key == config_key, trial.c.seed == int(seed))
        )
        with self._snapshot() as connection:
            row = connection.execute(statement).one_or_none()
        if row is None:
            raise QueryError(
                f"There is no trajectory of seed {seed} of configuration {config_key[:12]} in "
                f"{self.safe_url}: run that trial first."
            )
        dtype, *packed = row
        return Trajectory(*(unpack(dtype, *packed[i : i + 2]) for i in (0, 2, 4)))

    def query(self, sql: str) -> Table:
        """Return the rows of one SELECT, each with its values by place and by name of column.

        Raises ``QueryError`` where the database refuses the statement, as it does any that writes.
        """
        with translated_query(self.safe_url), self._engine.begin() as connection:
            # Without parameters, so that a % in the statement needs no escape.
            result = connection.exec_driver_sql(sql, execution_options={"no_parameters": True})
            return Table(result.keys(), result) if result.returns_rows else Table((), ())

    @contextmanager
    def _snapshot(self) -> Iterator[Connection]:
        with translated(self.safe_url), self._engine.begin() as connection:
            yield connection


def _cell(*values: Any) -> Cell:
    return Cell(*values[:-1], json.loads(values[-1]))  # type: ignore[call-arg]


def _numbers(result: CursorResult[Any]) -> Array:
    """Return the only column of a result, NULL as NaN.

    It comes from the driver's cursor, because a SQLAlchemy row for each number doubles the time.
    """
    rows = cast("Iterable[tuple[float | None]]", result.cursor)
    return np.fromiter(chain.from_iterable(rows), np.float64)


def _check_column(column: str) -> None:
    if column not in STEP_VALUES:
        near = difflib.get_close_matches(column, STEP_VALUES, n=1)
        hint = f"did you mean '{near[0]}'?" if near else "choose one of these."
        raise QueryError(
            f"A step has no column '{column}', its columns are {', '.join(STEP_VALUES)}: {hint}"
        )


def _config(connection: Connection, config_key: str) -> tuple[int, int]:
    row = connection.execute(
        select(config.c.config_id, config.c.horizon).where(config.c.config_key == config_key)
    ).one_or_none()
    if row is None:
        raise QueryError(
            f"The configuration {config_key[:12]} is not in the database: "
            "take one of those that cells() returns."
        )
    return row[0], row[1]
