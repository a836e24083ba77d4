"""Source database of a merge: its complete trials in pages, read from one snapshot."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate, groupby
from operator import itemgetter
from typing import Any

import numpy as np

from orchestrate.store.doctor import TrialKey
from orchestrate.store.errors import StoreError
from orchestrate.store.read.reader import Reader
from orchestrate.store.records import Array
from orchestrate.store.schema import N_ROWS, PREQUENTIAL, STEP_VALUES
from orchestrate.store.serialization import DTYPE, stored_json, unpack

PAGE = 50
"""Trials in one transaction, so that a concurrent launch waits for less than a second."""

PAGE_STEPS = 5_000
"""Steps in one transaction, unless its only trial has more, which bounds the memory."""

_TRIALS = (
    f"SELECT r.*, c.config_key, {N_ROWS} AS n_rows, c.env, c.policy, e.hash AS error_hash, "
    f"CASE WHEN c.config_json LIKE '{PREQUENTIAL}' THEN 1 ELSE 0 END AS grows FROM trial r "
    "JOIN config c ON c.config_id = r.config_id LEFT JOIN error e ON e.error_id = r.error_id "
    "WHERE r.trial_id > :last AND r.status IN ('done', 'diverged', 'failed', 'cancelled') "
    "ORDER BY r.trial_id LIMIT :size"
)
_ATTEMPTS = (
    "SELECT a.*, e.hash AS error_hash FROM attempt a "
    "LEFT JOIN error e ON e.error_id = a.error_id "
    "WHERE a.trial_id BETWEEN :first AND :last AND a.outcome IS NOT NULL "
    "ORDER BY a.trial_id, a.attempt"
)
_FINISHED = (
    "trial_id IN (SELECT trial_id FROM trial WHERE trial_id BETWEEN :first AND :last "
    "AND status IN ('done', 'diverged'))"
)
_STEPS = (
    f"SELECT trial_id, t, {', '.join(STEP_VALUES)} FROM step WHERE {_FINISHED} ORDER BY trial_id, t"
)
_TRAJECTORIES = f"SELECT * FROM trajectory WHERE {_FINISHED}"
_ASSESSMENTS = (
    f"SELECT trial_id, t, measure, value FROM assessment WHERE {_FINISHED} "
    "ORDER BY trial_id, t, measure"
)
# All trials of a configuration have the same number of assessments, but for explorations.
_EXPECTED = (
    "SELECT config_id, max(n) FROM (SELECT r.config_id, count(*) AS n FROM assessment a "
    "JOIN trial r ON r.trial_id = a.trial_id JOIN config c ON c.config_id = r.config_id "
    f"WHERE r.status = 'done' AND c.config_json NOT LIKE '{PREQUENTIAL}' "
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


@dataclass(frozen=True)
class Page:
    """Trials of one transaction, and their rows in other tables, by trial_id.

    Attributes
    ----------
    trials
        Trials that have an outcome.
    attempts
        Finished attempts at a trial, the oldest first.
    curves
        Rows of the finished trials; none for a trial of which some are missing.
    contradictory
        Trials whose key is not that of their configuration, or whose arrays have other shapes.
    """

    trials: list[dict[str, Any]]
    attempts: Mapping[int, list[dict[str, Any]]]
    curves: Mapping[int, Curve]
    contradictory: Set[int]


class Source:
    """Queries to a snapshot of the source database; ``trial_key`` is as in :func:`merge`."""

    def __init__(self, moment: Reader, trial_key: TrialKey | None = None) -> None:
        self._moment, self._trial_key = moment, trial_key
        self._texts: dict[int, str] = {}  # JSON of configurations, empty for another than its key
        self._expected = dict(map(tuple, moment.rows(_EXPECTED)))

    def launches(self) -> list[dict[str, Any]]:
        self._moment.launches()  # refuses texts that the readers of the target could not read
        return self._dicts("SELECT * FROM launch ORDER BY launch_id")

    def pages(self) -> Iterator[Page]:
        """Yield the trials that have an outcome, with their rows."""
        last = 0
        while trials := _first(self._dicts(_TRIALS, last=last, size=PAGE)):
            first, last = trials[0]["trial_id"], trials[-1]["trial_id"]
            attempts = defaultdict(list)
            for row in self._dicts(_ATTEMPTS, first=first, last=last):
                attempts[row["trial_id"]].append(row)
            curves = self._curves(trials)
            wrong = {
                row["trial_id"]
                for row in trials
                if not (self._has_its_key(row) and _agree(row, curves.get(row["trial_id"])))
            }
            yield Page(trials, attempts, curves, wrong)

    def _has_its_key(self, row: Mapping[str, Any]) -> bool:
        """Return whether keys are hashes of what is stored: no specification is built of it."""
        if (config_id := row["config_id"]) not in self._texts:
            text = self.config(config_id)["config_json"]
            same = hashlib.sha256(text.encode()).hexdigest() == row["config_key"]
            with suppress(StoreError):
                stored_json(text, dict)
                self._texts[config_id] = text if same else ""
        text = self._texts.get(config_id, "")
        key = self._trial_key(text, row["seed"]) if self._trial_key else row["trial_key"]
        return bool(text) and key == row["trial_key"]

    def config(self, config_id: int) -> dict[str, Any]:
        (row,) = self._dicts("SELECT * FROM config WHERE config_id = :id", id=config_id)
        return row

    def error(self, digest: str) -> dict[str, Any]:
        (row,) = self._dicts("SELECT * FROM error WHERE hash = :hash", hash=digest)
        return row

    def _curves(self, trials: Sequence[dict[str, Any]]) -> dict[int, Curve]:
        ends = {"first": trials[0]["trial_id"], "last": trials[-1]["trial_id"]}
        steps = _by_trial(self._moment.rows(_STEPS, **ends))
        assessments = _by_trial(self._moment.rows(_ASSESSMENTS, **ends))
        trajectories = {row.pop("trial_id"): row for row in self._dicts(_TRAJECTORIES, **ends)}
        curves = {}
        for row in trials:
            trial_id = row["trial_id"]
            values = np.array(steps.get(trial_id, []), np.float64).reshape(-1, 1 + len(STEP_VALUES))
            assessed = assessments.get(trial_id, [])
            expected = self._expected.get(row["config_id"]) if row["status"] == "done" else None
            if (
                trial_id in trajectories
                and len(values) == row["n_rows"]
                and np.array_equal(values[:, 0], np.arange(len(values)))
                and expected in (None, len(assessed))
            ):
                packed = {name: _bytes(one) for name, one in trajectories[trial_id].items()}
                curves[trial_id] = Curve(values[:, 1:], packed, assessed)
        return curves

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


def _first(trials: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the trials that fit into one transaction by their steps, and at least one."""
    steps = accumulate(row["n_rows"] or 0 for row in trials)
    fitting = sum(n <= PAGE_STEPS for n in steps)
    return trials[: max(fitting, 1)]


def _by_trial(rows: Iterable[tuple[Any, ...]]) -> dict[int, list[tuple[Any, ...]]]:
    """Return the rows without their trial_id, the first column, by which they are sorted."""
    groups = groupby(rows, key=itemgetter(0))
    return {trial_id: [row[1:] for row in group] for trial_id, group in groups}


def _bytes(value: Any) -> Any:
    return bytes(value) if isinstance(value, memoryview) else value
