"""Merge of another results database into this one, without overwriting any result.

The source is read from one snapshot, in pages, each of which is one transaction here. A trial is
identified by its key, an attempt by its launch and time, a launch by its token, so that a merge
that was killed can be repeated, and repeating a finished merge changes nothing.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, bindparam, delete, insert, select, update

from dopt.types import Array
from orchestrate.errors import StoreError
from orchestrate.store import records, sqlite
from orchestrate.store.backend import Backend, parse_url, public_url, sqlite_path
from orchestrate.store.reader import Reader
from orchestrate.store.records import DTYPE, stored_json, unpack
from orchestrate.store.schema import (
    FINISHED,
    N_ROWS,
    OUTCOME_COLUMNS,
    PREQUENTIAL,
    SAMPLE_LOSS,
    STEP_VALUES,
    assessment,
    attempt,
    config,
    launch,
    trial,
)
from orchestrate.store.schema import step as step_table
from orchestrate.store.schema import trajectory as trajectory_table
from orchestrate.store.store import Store, insert_error, steps_ahead, unpacked

PAGE = 50
"""Trials in one transaction, so that a concurrent launch waits for less than a second."""

PAGE_STEPS = 5_000
"""Steps in one transaction, unless its only trial has more, which bounds the memory."""

_TRIALS = (
    f"SELECT r.*, c.config_key, {N_ROWS} AS n_rows, c.env, c.policy, "
    f"CASE WHEN c.config_json LIKE '{PREQUENTIAL}' THEN 1 ELSE 0 END AS grows FROM trial r "
    "JOIN config c ON c.config_id = r.config_id "
    "WHERE r.trial_id > :last AND r.status IN ('done', 'diverged', 'failed', 'cancelled') "
    "ORDER BY r.trial_id LIMIT :size"
)
_ATTEMPTS = (
    "SELECT * FROM attempt WHERE trial_id BETWEEN :first AND :last AND outcome IS NOT NULL "
    "ORDER BY trial_id, attempt"
)
# All trials of a configuration have the same number of assessments, except explorations, beside
# the sample loss, which may have been stored of some alone.
EXPECTED = (
    "SELECT config_id, max(n) AS most FROM (SELECT r.config_id, count(*) AS n FROM assessment a "
    "JOIN trial r ON r.trial_id = a.trial_id JOIN config c ON c.config_id = r.config_id "
    f"WHERE r.status = 'done' AND c.config_json NOT LIKE '{PREQUENTIAL}' "
    f"AND a.measure <> '{SAMPLE_LOSS}' "
    "GROUP BY a.trial_id, r.config_id) AS counts GROUP BY config_id"
)


@dataclass(frozen=True)
class Curve:
    """Steps, trajectory and assessments of a finished trial.

    Attributes
    ----------
    steps : (T, number of STEP_VALUES)
    trajectory
        Row of the table, without the trial_id.
    assessments
        Rows of the table: step, measure, value.
    """

    steps: Array
    trajectory: dict[str, Any]
    assessments: list[tuple[int, str, float | None]]


def curves(connection: Connection, trial_ids: Sequence[int]) -> dict[int, Curve]:
    """Return what is stored of trials; those that lack a trajectory, or a step, are left out."""
    steps, arrays, assessments = (
        _by_trial(connection.execute(select(table).where(table.c.trial_id.in_(trial_ids))))
        for table in (step_table, trajectory_table, assessment)
    )
    found = {}
    for trial_id, (row,) in arrays.items():
        numbers = np.array(sorted(steps.get(trial_id, [])), np.float64)
        numbers = numbers.reshape(-1, 1 + len(STEP_VALUES))
        if np.array_equal(numbers[:, 0], np.arange(len(numbers))):
            packed = dict(zip(_ARRAYS, row, strict=True))
            rows = sorted(assessments.get(trial_id, []))
            found[trial_id] = Curve(numbers[:, 1:], packed, rows)
    return found


_ARRAYS = [one.name for one in trajectory_table.columns][1:]


def _by_trial(rows: Iterable[Row[Any]]) -> dict[int, list[tuple[Any, ...]]]:
    """Return rows by their trial_id, the first column, without it."""
    found = defaultdict[int, list[tuple[Any, ...]]](list)
    for row in rows:
        found[row[0]].append(tuple(row[1:]))
    return found


@dataclass(frozen=True)
class Candidate:
    """Trial of the source that has an outcome, and its rows in other tables.

    Attributes
    ----------
    row
        Its row, with the name of its configuration.
    attempts
        Finished attempts at it, the oldest first.
    curve
        Rows of a finished trial; None if some are missing.
    contradictory
        Whether its key does not match its configuration, or its arrays have other shapes.
    """

    row: dict[str, Any]
    attempts: Sequence[dict[str, Any]]
    curve: Curve | None
    contradictory: bool


class Source:
    """Queries to a snapshot of the source database."""

    def __init__(self, moment: Reader) -> None:
        self._moment = moment
        self._texts: dict[int, str] = {}  # JSON of configurations, empty for another than its key
        self._expected = dict(map(tuple, moment.rows(EXPECTED)))

    def launches(self) -> list[dict[str, Any]]:
        self._moment.launches()  # refuses texts that the readers of the target could not read
        return self._dicts("SELECT * FROM launch ORDER BY launch_id")

    def pages(self) -> Iterator[list[Candidate]]:
        """Yield the trials that have an outcome, as many at once as one transaction takes."""
        last = 0
        while rows := self._dicts(_TRIALS, last=last, size=PAGE):
            steps = accumulate(row["n_rows"] or 0 for row in rows)
            rows = rows[: max(sum(n <= PAGE_STEPS for n in steps), 1)]
            last = rows[-1]["trial_id"]
            yield self._candidates(rows, {"first": rows[0]["trial_id"], "last": last})

    def _candidates(
        self, rows: Sequence[dict[str, Any]], ends: Mapping[str, int]
    ) -> list[Candidate]:
        attempts = defaultdict(list)
        for row in self._dicts(_ATTEMPTS, **ends):
            attempts[row["trial_id"]].append(row)
        finished = [row["trial_id"] for row in rows if row["status"] in FINISHED]
        with self._moment._snapshot() as connection:
            stored = curves(connection, finished)
        found = []
        for row in rows:
            curve = stored.get(row["trial_id"])
            if curve is not None and not self._is_whole(row, curve):
                curve = None
            wrong = not (self._has_its_key(row) and _agree(row, curve))
            found.append(Candidate(row, attempts[row["trial_id"]], curve, wrong))
        return found

    def _is_whole(self, row: Mapping[str, Any], curve: Curve) -> bool:
        expected = self._expected.get(row["config_id"]) if row["status"] == "done" else None
        n_assessments = len(_of_all(curve.assessments))
        return len(curve.steps) == row["n_rows"] and expected in (None, n_assessments)

    def _has_its_key(self, row: Mapping[str, Any]) -> bool:
        """Return whether keys are hashes of what is stored: no specification is built of it."""
        if (config_id := row["config_id"]) not in self._texts:
            text = self.config(config_id)["config_json"]
            same = records.config_key(text) == row["config_key"]
            with suppress(StoreError):
                stored_json(text, dict)
                self._texts[config_id] = text if same else ""
        text = self._texts.get(config_id, "")
        return bool(text) and records.trial_key(text, row["seed"]) == row["trial_key"]

    def config(self, config_id: int) -> dict[str, Any]:
        (row,) = self._dicts("SELECT * FROM config WHERE config_id = :id", id=config_id)
        return row

    def error(self, error_id: int) -> dict[str, Any]:
        (row,) = self._dicts("SELECT * FROM error WHERE error_id = :id", id=error_id)
        return row

    def _dicts(self, sql: str, **values: Any) -> list[dict[str, Any]]:
        table = self._moment.rows(sql, **values)
        return [dict(zip(table.columns, row, strict=True)) for row in table]


def _agree(row: Mapping[str, Any], curve: Curve | None) -> bool:
    """Return whether the arrays of a trial have their shapes, and as many steps as the trial."""
    if curve is None:
        return True
    packed, names = curve.trajectory, ("states", "inputs", "parameters")
    try:
        arrays = [unpack(DTYPE, packed[f"{name}_shape"], packed[name]) for name in names]
        states, inputs, parameters = arrays
        sizes = states.ndim, inputs.ndim, parameters.ndim, len(states), packed["dtype"]
        steps = len(inputs)
    except (StoreError, TypeError):
        return False
    same = all(packed[f"{names[i]}_shape"] == json.dumps(arrays[i].shape) for i in range(3))
    fits = row["grows"] or row["n_rows"] == steps
    return bool(same and fits and sizes == (2, 2, 1, steps + 1, DTYPE))


def _of_all(assessments: Iterable[Sequence[Any]]) -> list[tuple[Any, ...]]:
    """Return the assessments, (t, measure, value), that all trials of a configuration have."""
    return [tuple(one) for one in assessments if one[1] != SAMPLE_LOSS]


_COPIED = ("status", *OUTCOME_COLUMNS)
_NUMBERS = [STEP_VALUES.index(name) for name in ("loss", "reachable_loss")]
_INSERT_TRIALS = insert(trial).returning(trial.c.trial_key, trial.c.trial_id)
_UPDATE_TRIAL = update(trial).where(trial.c.trial_id == bindparam("here"))


class Target:
    """Transaction of a merge."""

    def __init__(
        self, connection: Connection, backend: Backend, source: Source, launches: Mapping[int, int]
    ) -> None:
        self._connection = connection
        self._backend = backend
        self._source = source
        self._launches = launches
        self._configs: dict[str, int] = {}  # config_id here by key, filled on the way
        self._errors: dict[int, int] = {}  # error_id here by the one there
        self._added: list[tuple[Candidate, Row[Any] | None]] = []

    def known(self, keys: Sequence[str]) -> dict[str, Row[Any]]:
        """Return the trials with these keys, locked until the end of the transaction."""
        statement = select(trial).where(trial.c.trial_key.in_(self._backend.members(keys)))
        # Locked in the order of a commit, which avoids deadlocks.
        statement = statement.order_by(trial.c.trial_id).with_for_update()
        rows = self._connection.execute(statement)
        return {row.trial_key: row for row in rows}

    def with_new_attempts(self, one: Candidate, here: Row[Any] | None) -> Candidate:
        """Return a trial of the source with the attempts alone that are new in this database."""
        if here is None:
            return one
        statement = select(attempt.c.launch_id, attempt.c.claimed)
        found = self._connection.execute(statement.where(attempt.c.trial_id == here.trial_id))
        known = set(map(tuple, found))
        new = [
            a for a in one.attempts if (self._launches[a["launch_id"]], a["claimed"]) not in known
        ]
        return replace(one, attempts=new)

    def add(self, one: Candidate, here: Row[Any] | None) -> None:
        """Note a trial with its outcome and new attempts, for :meth:`write`."""
        self._added.append((one, here))

    def write(self) -> None:
        """Write the noted trials, with one statement for each table."""
        ids = self._write_trials()
        attempts: list[dict[str, Any]] = []
        curves, trajectories, assessments = [], [], []
        for one, here in self._added:
            trial_id = ids[one.row["trial_key"]]
            attempts += self._attempt_rows(trial_id, one, here)
            if one.curve is not None:
                self._backend.insert_steps(self._connection, trial_id, one.curve.steps)
                curves.append((trial_id, _last_attempt(one, here), one.curve.steps))
                trajectories.append({"trial_id": trial_id, **one.curve.trajectory})
                assessments += [
                    {"trial_id": trial_id, "t": t, "measure": measure, "value": value}
                    for t, measure, value in one.curve.assessments
                ]
        records.write_curves(self._connection, curves)
        for table, rows in (
            (attempt, attempts),
            (trajectory_table, trajectories),
            (assessment, assessments),
        ):
            if rows:
                self._connection.execute(insert(table), rows)

    def curve(self, here: Row[Any]) -> Curve | None:
        """Return what is stored of a finished trial; None if some is missing."""
        return curves(self._connection, [here.trial_id]).get(here.trial_id)

    def clear(self, here: Row[Any]) -> None:
        """Delete the rows of an exploration that has more steps in the source."""
        for table in (step_table, trajectory_table, assessment):
            self._connection.execute(delete(table).where(table.c.trial_id == here.trial_id))

    def _write_trials(self) -> dict[str, int]:
        """Return the ids of the noted trials by their keys."""
        ids, new = {}, []
        for one, here in self._added:
            row = one.row
            values = {name: row[name] for name in _COPIED} | {"attempt": _last_attempt(one, here)}
            for name in ("launch_id", "registered_by"):
                values[name] = self._launches.get(row[name])
            values["error_id"] = self._error(row["error_id"])
            if here is None:
                values |= {"trial_key": row["trial_key"], "seed": row["seed"]}
                new.append(
                    values | {"config_id": self._config(row["config_key"], row["config_id"])}
                )
            else:
                ids[row["trial_key"]] = here.trial_id
                self._connection.execute(_UPDATE_TRIAL, {"here": here.trial_id, **values})
        if new:
            ids |= dict(map(tuple, self._connection.execute(_INSERT_TRIALS, new)))
        return ids

    def _attempt_rows(
        self, trial_id: int, one: Candidate, here: Row[Any] | None
    ) -> Iterator[dict[str, Any]]:
        before = _last_attempt(one, here) - len(one.attempts)
        for number, row in enumerate(one.attempts, start=before + 1):
            values = {name: row[name] for name in attempt.c.keys()}  # noqa: SIM118  not a dict
            yield values | {
                "trial_id": trial_id,
                "attempt": number,
                "launch_id": self._launches[row["launch_id"]],
                "error_id": self._error(row["error_id"]),
            }

    def _config(self, config_key: str, there: int) -> int:
        if config_key not in self._configs:
            statement = select(config.c.config_id).where(config.c.config_key == config_key)
            here = self._connection.execute(statement).scalar()
            if here is None:
                values = self._source.config(there)
                del values["config_id"]
                adding = insert(config).values(values).returning(config.c.config_id)
                here = self._connection.execute(adding).scalar_one()
            self._configs[config_key] = int(here)
        return self._configs[config_key]

    def _error(self, there: int | None) -> int | None:
        if there is not None and there not in self._errors:
            self._errors[there] = insert_error(self._connection, self._source.error(there))
        return None if there is None else self._errors[there]


def _is_same(here: Row[Any], mine: Curve, row: Mapping[str, Any], there: Curve) -> bool:
    """Return whether both databases hold equal numbers of a trial; times may differ."""
    pairs = mine.steps[:, _NUMBERS], there.steps[:, _NUMBERS]
    return (
        all(getattr(here, name) == row[name] for name in ("status", "n_steps", "diverged_at"))
        and _of_all(mine.assessments) == _of_all(there.assessments)
        and np.array_equal(*pairs, equal_nan=True)
        and mine.trajectory == there.trajectory
    )


def _last_attempt(one: Candidate, here: Row[Any] | None) -> int:
    """Return the number of the last attempt in this database at a trial with new attempts."""
    return (0 if here is None else int(here.attempt)) + len(one.attempts)


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


@dataclass(frozen=True)
class TrialName:
    """Trial with a conflict or with missing rows."""

    trial_key: str
    env: str
    policy: str
    seed: int


@dataclass
class Merged:
    """Result of a merge.

    Attributes
    ----------
    added
        Copied trials, by status.
    identical
        Trials finished in both databases with equal numbers.
    kept
        Trials that failed or were cancelled there and have an outcome here, and explorations that
        have more steps here.
    running
        Trials that a launch is running here, which were not copied.
    conflicts
        Trials finished in both databases with different numbers, which were not copied.
    incomplete
        Trials with missing rows there, which were not copied.
    contradictory
        Trials there whose key does not match their configuration and seed, or whose arrays have
        other shapes than they say, which were not copied.
    launches
        New launches.
    """

    added: dict[str, int] = field(default_factory=dict)
    identical: int = 0
    kept: int = 0
    running: int = 0
    conflicts: list[TrialName] = field(default_factory=list)
    incomplete: list[TrialName] = field(default_factory=list)
    contradictory: list[TrialName] = field(default_factory=list)
    launches: int = 0

    def include(self, other: Merged) -> None:
        """Add the counts of one more merge into the same database."""
        for status, count in other.added.items():
            self.added[status] = self.added.get(status, 0) + count
        for name in vars(self).keys() - {"added"}:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    @property
    def changed(self) -> bool:
        return bool(self.added or self.launches)


def merge(url: str, other_url: str) -> Merged:
    """Bring the trials with an outcome of ``other_url`` into ``url``, and what belongs to them.

    Either may be SQLite or PostgreSQL; the first is created where nothing is, the other is only
    read. Raises ``StoreError`` as the opening of a store and of a reader do.
    """
    _refuse_itself(url, other_url)
    merged = Merged()
    with Reader.open(other_url) as reader, reader.moment() as moment, Store.open(url) as store:
        store.recover()
        source = Source(moment)
        with store._backend.transaction() as connection:
            store._backend.exclusive(connection)
            launches, merged.launches = add_launches(connection, source.launches())
        for page in source.pages():
            with store._backend.transaction() as connection:
                store._backend.exclusive(connection)
                target = Target(connection, store._backend, source, launches)
                known = target.known([one.row["trial_key"] for one in page])
                found = [
                    (_merge_trial(target, one, known.get(one.row["trial_key"])), one.row)
                    for one in page
                ]
                target.write()
            _count(merged, found)
    return merged


def _merge_trial(target: Target, one: Candidate, here: Row[Any] | None) -> str:
    """Copy one trial if it is new here; return the outcome as a field of :class:`Merged`."""
    row, curve = one.row, one.curve
    if one.contradictory:
        return "contradictory"
    finished = row["status"] in FINISHED
    if here is not None and here.status == "running":
        return "running"
    if here is not None and not finished and here.status != "pending":
        return "kept"
    if finished and curve is None:
        return "incomplete"
    if curve is not None and here is not None and here.status in FINISHED:
        mine, ahead = target.curve(here), None
        if mine is not None and _is_same(here, mine, row, curve):
            return "identical"
        if mine is not None and row["grows"]:
            ahead = steps_ahead(unpacked(mine.trajectory), unpacked(curve.trajectory))
        if ahead is None or ahead == 0:
            return "conflicts"
        if ahead > 0:
            return "kept"
        target.clear(here)
    new = target.with_new_attempts(one, here)
    if here is not None and row["status"] != "done" and not new.attempts:
        return "kept"  # it was merged before, and a new run was requested here since
    target.add(new, here)
    return "added"


def _count(merged: Merged, found: Sequence[tuple[str, dict[str, Any]]]) -> None:
    for fate, row in found:
        if fate == "added":
            merged.added[row["status"]] = merged.added.get(row["status"], 0) + 1
        elif fate in ("conflicts", "incomplete", "contradictory"):
            name = TrialName(row["trial_key"], row["env"], row["policy"], row["seed"])
            getattr(merged, fate).append(name)
        else:
            setattr(merged, fate, getattr(merged, fate) + 1)


def _refuse_itself(url: str, other_url: str) -> None:
    one, other = parse_url(url), parse_url(other_url)
    if one.get_backend_name() == other.get_backend_name() == "sqlite":
        same = sqlite_path(one) == sqlite.existing_path(other)
    else:
        same = one == other
    if same:
        raise StoreError(
            f"Both databases are {public_url(one)}: give another one to merge into it."
        )
