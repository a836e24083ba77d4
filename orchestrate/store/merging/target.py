"""Target database of a merge: inserts rows of the source with new ids."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, bindparam, delete, insert, select, update

from orchestrate.store import packed_curves
from orchestrate.store.backends.base import Backend
from orchestrate.store.growth import steps_ahead, unpacked
from orchestrate.store.merging.source import Curve, Source
from orchestrate.store.schema import (
    OUTCOME_COLUMNS,
    STEP_VALUES,
    assessment,
    attempt,
    config,
    error,
    launch,
    trial,
)
from orchestrate.store.schema import step as step_table
from orchestrate.store.schema import trajectory as trajectory_table
from orchestrate.store.write.results import insert_error

_COPIED = ("status", *OUTCOME_COLUMNS)
_NUMBERS = [STEP_VALUES.index(name) for name in ("loss", "reachable_loss")]
_ASSESSMENTS = select(assessment.c.t, assessment.c.measure, assessment.c.value).order_by(
    assessment.c.t, assessment.c.measure
)
_INSERT_TRIALS = insert(trial).returning(trial.c.trial_key, trial.c.trial_id)
_UPDATE_TRIAL = update(trial).where(trial.c.trial_id == bindparam("here"))
_STEPS = select(*(step_table.c[name] for name in STEP_VALUES)).order_by(step_table.c.t)


@dataclass(frozen=True)
class _Added:
    """Trial of the source, its row in this database, and what is new here."""

    row: Mapping[str, Any]
    here: Row[Any] | None
    attempts: Sequence[Mapping[str, Any]]
    curve: Curve | None

    @property
    def attempt(self) -> int:
        """Number of its last attempt in this database."""
        return (0 if self.here is None else int(self.here.attempt)) + len(self.attempts)


class Target:
    """Transaction of a merge."""

    def __init__(
        self,
        connection: Connection,
        backend: Backend,
        source: Source,
        launches: Mapping[int, int],
    ) -> None:
        self._connection = connection
        self._backend = backend
        self._source = source
        self._launches = launches
        self._configs: dict[str, int] = {}  # config_id here by key, filled on the way
        self._added: list[_Added] = []

    def known(self, keys: Sequence[str]) -> dict[str, Row[Any]]:
        """Return the trials with these keys, locked until the end of the transaction."""
        statement = select(trial).where(trial.c.trial_key.in_(self._backend.members(keys)))
        # Locked in the order of a commit, which avoids deadlocks.
        statement = statement.order_by(trial.c.trial_id).with_for_update()
        rows = self._connection.execute(statement)
        return {row.trial_key: row for row in rows}

    def new_attempts(
        self, there: list[dict[str, Any]], here: Row[Any] | None
    ) -> list[dict[str, Any]]:
        """Return the attempts at a trial of the source that are new in this database."""
        if here is None:
            return there
        statement = select(attempt.c.launch_id, attempt.c.claimed)
        known = {
            tuple(one)
            for one in self._connection.execute(
                statement.where(attempt.c.trial_id == here.trial_id)
            )
        }
        return [a for a in there if (self._launches[a["launch_id"]], a["claimed"]) not in known]

    def add(
        self,
        row: Mapping[str, Any],
        here: Row[Any] | None,
        attempts: Sequence[Mapping[str, Any]],
        curve: Curve | None,
    ) -> None:
        """Note a trial with its outcome, for :meth:`write`."""
        self._added.append(_Added(row, here, attempts, curve))

    def write(self) -> None:
        """Write the noted trials, with one statement for each table."""
        ids = self._write_trials()
        attempts: list[dict[str, Any]] = []
        curves, trajectories, assessments = [], [], []
        for one in self._added:
            trial_id = ids[one.row["trial_key"]]
            attempts += self._attempt_rows(trial_id, one)
            if one.curve is not None:
                self._backend.insert_steps(self._connection, trial_id, one.curve.steps)
                curves.append((trial_id, one.attempt, one.curve.steps))
                trajectories.append({"trial_id": trial_id, **one.curve.trajectory})
                assessments += [
                    {"trial_id": trial_id, "t": t, "measure": measure, "value": value}
                    for t, measure, value in one.curve.assessments
                ]
        packed_curves.write(self._connection, curves)
        for table, rows in (
            (attempt, attempts),
            (trajectory_table, trajectories),
            (assessment, assessments),
        ):
            if rows:
                self._connection.execute(insert(table), rows)

    def is_same(self, here: Row[Any], row: Mapping[str, Any], there: Curve) -> bool:
        """Return whether both databases hold equal numbers; times may differ."""
        if any(getattr(here, name) != row[name] for name in ("status", "n_steps", "diverged_at")):
            return False
        where = here.trial_id
        steps = self._connection.execute(_STEPS.where(step_table.c.trial_id == where)).all()
        mine = np.array([tuple(one) for one in steps], dtype=np.float64)
        arrays = self._connection.execute(
            select(trajectory_table).where(trajectory_table.c.trial_id == where)
        ).one_or_none()
        rows = self._connection.execute(_ASSESSMENTS.where(assessment.c.trial_id == where))
        return (
            sorted(map(tuple, rows)) == sorted(there.assessments)
            and mine.shape == there.steps.shape
            and np.array_equal(mine[:, _NUMBERS], there.steps[:, _NUMBERS], equal_nan=True)
            and arrays is not None
            and all(getattr(arrays, name) == value for name, value in there.trajectory.items())
        )

    def steps_ahead(self, here: Row[Any], there: Curve) -> int | None:
        """Return by how many steps an exploration is longer here; None if it is another one."""
        statement = select(trajectory_table).where(trajectory_table.c.trial_id == here.trial_id)
        mine = self._connection.execute(statement).mappings().one_or_none()
        if mine is None:
            return None
        return steps_ahead(unpacked(dict(mine)), unpacked(there.trajectory))

    def clear(self, here: Row[Any]) -> None:
        """Delete the rows of an exploration that has more steps in the source."""
        for table in (step_table, trajectory_table, assessment):
            self._connection.execute(delete(table).where(table.c.trial_id == here.trial_id))

    def _write_trials(self) -> dict[str, int]:
        """Return the ids of the noted trials by their keys."""
        ids, new = {}, []
        for one in self._added:
            row = one.row
            values = {name: row[name] for name in _COPIED} | {"attempt": one.attempt}
            for name in ("launch_id", "registered_by"):
                values[name] = self._launches.get(row[name])
            values["error_id"] = self._error(row["error_hash"])
            if one.here is None:
                values |= {"trial_key": row["trial_key"], "seed": row["seed"]}
                new.append(
                    values | {"config_id": self._config(row["config_key"], row["config_id"])}
                )
            else:
                ids[row["trial_key"]] = one.here.trial_id
                self._connection.execute(_UPDATE_TRIAL, {"here": one.here.trial_id, **values})
        if new:
            ids |= dict(map(tuple, self._connection.execute(_INSERT_TRIALS, new)))
        return ids

    def _attempt_rows(self, trial_id: int, one: _Added) -> Iterator[dict[str, Any]]:
        for number, row in enumerate(one.attempts, start=one.attempt - len(one.attempts) + 1):
            values = {name: row[name] for name in attempt.c.keys()}  # noqa: SIM118  not a dict
            yield values | {
                "trial_id": trial_id,
                "attempt": number,
                "launch_id": self._launches[row["launch_id"]],
                "error_id": self._error(row["error_hash"]),
            }

    def _config(self, config_key: str, there: int) -> int:
        if config_key not in self._configs:
            self._configs[config_key] = self._find_config(config_key, there)
        return self._configs[config_key]

    def _find_config(self, config_key: str, there: int) -> int:
        statement = select(config.c.config_id).where(config.c.config_key == config_key)
        here = self._connection.execute(statement).scalar()
        if here is None:
            values = self._source.config(there)
            del values["config_id"]
            adding = insert(config).values(values).returning(config.c.config_id)
            here = self._connection.execute(adding).scalar_one()
        return int(here)

    def _error(self, digest: str | None) -> int | None:
        if digest is None:
            return None
        statement = select(error.c.error_id).where(error.c.hash == digest)
        here = self._connection.execute(statement).scalar()
        if here is None:
            values = self._source.error(digest)
            del values["error_id"]
            return insert_error(self._connection, values)
        return int(here)


def add_launches(
    connection: Connection, rows: Sequence[Mapping[str, Any]]
) -> tuple[dict[int, int], int]:
    """Insert the launches of the source; return their ids here, and the number of new ones.

    A launch that is running there is inserted as lost; a later merge updates it.
    """
    known = {row.token: row for row in connection.execute(select(launch))}
    numbers, added = {}, 0
    for row in rows:
        values = {name: row[name] for name in launch.c.keys() if name != "launch_id"}  # noqa: SIM118
        running = row["state"] == "running"
        values |= {"lease_until": None, "state": "lost" if running else row["state"]}
        here = known.get(row["token"])
        if here is None:
            adding = insert(launch).values(values).returning(launch.c.launch_id)
            numbers[row["launch_id"]] = int(connection.execute(adding).scalar_one())
            added += 1
            continue
        numbers[row["launch_id"]] = here.launch_id
        if here.state == "lost" and here.ended is None and not running:
            where = launch.c.launch_id == here.launch_id
            connection.execute(update(launch).where(where).values(values))
    return numbers, added
