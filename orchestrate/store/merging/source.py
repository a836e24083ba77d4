"""Source database of a merge: its complete trials in pages, read from one snapshot."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from orchestrate.store.read.reader import Reader
from orchestrate.store.records import Array
from orchestrate.store.schema import N_ROWS, PREQUENTIAL, STEP_VALUES

PAGE = 50
"""Trials in one transaction, so that a concurrent launch waits for less than a second."""

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
    "WHERE a.trial_id = :trial_id AND a.outcome IS NOT NULL ORDER BY a.attempt"
)
_STEPS = f"SELECT t, {', '.join(STEP_VALUES)} FROM step WHERE trial_id = :trial_id ORDER BY t"


_ASSESSMENTS = (
    "SELECT t, measure, value FROM assessment WHERE trial_id = :trial_id ORDER BY t, measure"
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


class Source:
    """Queries to a snapshot of the source database."""

    def __init__(self, moment: Reader) -> None:
        self._moment = moment
        self._expected = dict(map(tuple, moment.rows(_EXPECTED)))

    def launches(self) -> list[dict[str, Any]]:
        return self._dicts("SELECT * FROM launch ORDER BY launch_id")

    def pages(self) -> Iterator[list[dict[str, Any]]]:
        """Yield the trials that have an outcome."""
        last = 0
        while page := self._dicts(_TRIALS, last=last, size=PAGE):
            last = page[-1]["trial_id"]
            yield page

    def config(self, config_id: int) -> dict[str, Any]:
        (row,) = self._dicts("SELECT * FROM config WHERE config_id = :id", id=config_id)
        return row

    def error(self, digest: str) -> dict[str, Any]:
        (row,) = self._dicts("SELECT * FROM error WHERE hash = :hash", hash=digest)
        return row

    def attempts(self, trial_id: int) -> list[dict[str, Any]]:
        """Return the finished attempts, the oldest first."""
        return self._dicts(_ATTEMPTS, trial_id=trial_id)

    def curve(self, row: dict[str, Any]) -> Curve | None:
        """Return the rows of a trial, or None if some are missing."""
        found = curve(self._moment, row["trial_id"], row["n_rows"])
        expected = self._expected.get(row["config_id"]) if row["status"] == "done" else None
        if found is None or expected not in (None, len(found.assessments)):
            return None
        return found

    def _dicts(self, sql: str, **values: Any) -> list[dict[str, Any]]:
        table = self._moment.rows(sql, **values)
        return [dict(zip(table.columns, row, strict=True)) for row in table]


def curve(moment: Reader, trial_id: int, n_rows: int) -> Curve | None:
    """Return the rows of a finished trial, or None if steps or the trajectory are missing."""
    steps = np.array(list(moment.rows(_STEPS, trial_id=trial_id)), dtype=np.float64)
    arrays = moment.rows("SELECT * FROM trajectory WHERE trial_id = :id", id=trial_id)
    if (
        len(arrays) != 1
        or len(steps) != n_rows
        or not np.array_equal(steps[:, 0], np.arange(n_rows))
    ):
        return None
    assessments = [tuple(row) for row in moment.rows(_ASSESSMENTS, trial_id=trial_id)]
    row = dict(zip(arrays.columns, arrays[0], strict=True))
    del row["trial_id"]
    packed = {key: _bytes(value) for key, value in row.items()}
    return Curve(steps[:, 1:], packed, assessments)


def _bytes(value: Any) -> Any:
    return bytes(value) if isinstance(value, memoryview) else value
