"""How far a grid is: numbers from the database, for any way to show them."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

from orchestrate.store import Cell, LaunchRow, Reader
from orchestrate.store.values import utc_text

RECENT = 300.0
"""Seconds over which the rate is taken."""

STATES = ("done", "diverged", "failed", "cancelled", "running", "pending")

_FAILURES = """
SELECT c.config_key, a.cause, a.error_id, e.type, e.message, count(*) AS attempts,
       sum(CASE WHEN r.status = 'failed' AND r.attempt = a.attempt THEN 1 ELSE 0 END) AS trials
FROM attempt a
JOIN trial r ON r.trial_id = a.trial_id
JOIN config c ON c.config_id = r.config_id
LEFT JOIN error e ON e.error_id = a.error_id
WHERE a.cause IS NOT NULL
GROUP BY c.config_key, a.cause, a.error_id, e.type, e.message
ORDER BY a.error_id
"""
_ENDED = """
SELECT c.config_key, a.launch_id, count(*) AS ended
FROM attempt a
JOIN trial r ON r.trial_id = a.trial_id
JOIN config c ON c.config_id = r.config_id
WHERE a.ended >= :since AND a.outcome IN ('done', 'diverged', 'failed')
GROUP BY c.config_key, a.launch_id
"""
_TRACEBACK = "SELECT traceback FROM error WHERE error_id = :error_id"
_NUMBER = re.compile(r"0x[0-9a-f]+|\d+(?:\.\d+)?(?:e[-+]?\d+)?", re.IGNORECASE)


@dataclass
class FailureKind:
    """Failures with one cause, type and message, up to the numbers in the message.

    Attributes
    ----------
    trials
        Trials that stand as failed by it.
    attempts
        Attempts that ended so, those included that were made good by a later one.
    cells
        Names (env, policy) of where it happened.
    """

    cause: str
    type: str | None
    message: str | None
    error_id: int | None
    trials: int = 0
    attempts: int = 0
    cells: set[tuple[str, str]] = field(default_factory=set)
    traceback: str = ""

    @property
    def last_line(self) -> str:
        """Last line of the traceback."""
        lines = self.traceback.strip().splitlines()
        return lines[-1].strip() if lines else ""

    @property
    def place(self) -> str:
        """Innermost frame of the traceback."""
        frames = re.findall(r"^ *File (.+)$", self.traceback, flags=re.MULTILINE)
        return frames[-1] if frames else ""


@dataclass(frozen=True)
class Status:
    """Some configurations of a grid, what failed in them and who works on them.

    Attributes
    ----------
    launches
        Those that say they run, dead ones included.
    rate
        Trials per second of the living launches over the last minutes.
    """

    cells: Sequence[Cell]
    failures: Sequence[FailureKind]
    launches: Sequence[LaunchRow]
    rate: float

    @property
    def counts(self) -> Counter[str]:
        """Number of trials in each state."""
        return counts(self.cells)

    @property
    def total(self) -> int:
        return self.counts.total()

    @property
    def left(self) -> int:
        """Trials without an outcome."""
        return self.counts["pending"] + self.counts["running"]

    @property
    def seconds_left(self) -> float | None:
        return self.left / self.rate if self.left and self.rate else None


def counts(cells: Iterable[Cell]) -> Counter[str]:
    """Return the number of trials in each state."""
    total = Counter(dict.fromkeys(STATES, 0))
    for cell in cells:
        total.update({state: getattr(cell, f"n_{state}") for state in STATES})
    return total


def gather(reader: Reader, cells: Sequence[Cell], kinds: int = 10) -> Status:
    """Return the status of the configurations, with tracebacks of the ``kinds`` commonest failures.

    ``reader`` sees one moment, that of ``cells``.
    """
    by_key = {cell.config_key: cell for cell in cells}
    running = [launch for launch in reader.launches() if launch.state == "running"]
    failures = _failures(reader, by_key)
    for kind in failures[:kinds]:
        if kind.error_id is not None:
            kind.traceback = str(reader.rows(_TRACEBACK, error_id=kind.error_id)[0][0])
    return Status(cells, failures, running, _rate(reader, by_key, running))


def _failures(reader: Reader, by_key: dict[str, Cell]) -> list[FailureKind]:
    found: dict[tuple[str, ...], FailureKind] = {}
    for row in reader.rows(_FAILURES):
        if row.config_key in by_key:
            name = (row.cause, row.type or "", _NUMBER.sub("#", row.message or ""))
            new = FailureKind(row.cause, row.type, row.message, row.error_id)
            kind = found.setdefault(name, new)
            kind.attempts += row.attempts
            kind.trials += row.trials
            cell = by_key[row.config_key]
            kind.cells.add((cell.env, cell.policy))
    return sorted(found.values(), key=lambda kind: (-kind.trials, -kind.attempts, kind.cause))


def _rate(reader: Reader, by_key: dict[str, Cell], running: Sequence[LaunchRow]) -> float:
    now = datetime.now(UTC)
    ended: Counter[int] = Counter()
    for row in reader.rows(_ENDED, since=utc_text(now - timedelta(seconds=RECENT))):
        ended[row.launch_id] += row.ended if row.config_key in by_key else 0
    alive = (launch for launch in running if launch.alive)
    spans = {one.launch_id: min(RECENT, max(1.0, seconds_since(one.started, now))) for one in alive}
    return math.fsum(ended[launch_id] / span for launch_id, span in spans.items())


def seconds_since(moment: str, now: datetime) -> float:
    """Return the seconds from a time of the database to ``now``."""
    return (now - datetime.fromisoformat(moment)).total_seconds()
