"""Everything that a launch has left in a database, as JSON: ``python -m tests.machines.outcome``.

It runs where the database can be reached, and names no time and no node of a result, which differ.
"""

from __future__ import annotations

import hashlib
import json
import sys
from dataclasses import dataclass
from typing import Any

from orchestrate.store import Reader

Row = tuple[Any, ...]

_QUERIES = {
    "curves": "SELECT seed, t, loss, reachable_loss FROM v_curve ORDER BY seed, t",
    "trials": (
        "SELECT seed, status, n_steps, final_loss, best_loss, diverged_at FROM trial ORDER BY seed"
    ),
    "trajectories": (
        "SELECT trial.seed, states, inputs, parameters FROM trajectory "
        "JOIN trial USING (trial_id) ORDER BY trial.seed"
    ),
    "attempts": (
        "SELECT seed, attempt.attempt, outcome, cause, attempt.node, attempt.launch_id, "
        "attempt.ended FROM attempt JOIN trial USING (trial_id) ORDER BY seed, attempt.attempt"
    ),
    "nodes": "SELECT node, count(*) FROM trial GROUP BY node ORDER BY node",
    "launches": "SELECT launch_id, state FROM launch ORDER BY launch_id",
}


@dataclass(frozen=True)
class Outcome:
    """Rows of the database; a long text of bytes is its digest."""

    curves: list[Row]
    trials: list[Row]
    trajectories: list[Row]
    attempts: list[Row]
    nodes: list[Row]
    launches: list[Row]

    @classmethod
    def from_json(cls, text: str) -> Outcome:
        return cls(**{key: [tuple(row) for row in rows] for key, rows in json.loads(text).items()})

    @property
    def results(self) -> list[list[Row]]:
        """What must be the same for every run of the grid, row by row and bit by bit."""
        return [self.trials, self.curves, self.trajectories]

    def check_complete(self, undisturbed: Outcome, seeds: int | None = None) -> None:
        """Check that the first trials, or all, are there once, as they are where nothing happens.

        A second outcome of a trial would be a second row of its steps, or an attempt too many.
        """
        count = len(undisturbed.trials) if seeds is None else seeds
        expected = [[row for row in rows if row[0] < count] for rows in undisturbed.results]
        assert self.results == expected
        done = [seed for seed, _, outcome, *_ in self.attempts if outcome == "done"]
        assert done == list(range(count))

    def attempts_of(self, outcome: str) -> dict[int, Row]:
        """Return the rows of the first attempts, by seed, that ended so."""
        return {row[0]: row for row in reversed(self.attempts) if row[2] == outcome}


def read(url: str) -> dict[str, list[list[Any]]]:
    """Return the rows of each query."""
    with Reader.open(url) as reader:
        return {
            key: [[_plain(value) for value in row] for row in reader.rows(sql)]
            for key, sql in _QUERIES.items()
        }


def _plain(value: Any) -> Any:
    if isinstance(value, bytes | memoryview):
        return hashlib.sha256(bytes(value)).hexdigest()
    return value


if __name__ == "__main__":
    json.dump(read(sys.argv[1]), sys.stdout)
