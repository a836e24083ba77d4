"""Status of a grid: counts, failures, running launches and the rate."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

from orchestrate.store import ConfigRow, ExplorationRow, LaunchRow, Reader, explorations
from orchestrate.store.serialization import utc_text

RATE_WINDOW_SECONDS = 300.0
"""Period over which the rate is averaged."""

STATES = ("done", "diverged", "failed", "cancelled", "running", "pending")
"""Statuses of a trial in the order of display."""

DETACHED = "launch.detach=true"

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
        Trials whose last attempt failed in this way.
    attempts
        Attempts that failed in this way, including those followed by a successful one.
    places
        Names (env, policy) of the configurations.
    """

    cause: str
    type: str | None
    message: str | None
    error_id: int | None
    trials: int = 0
    attempts: int = 0
    places: set[tuple[str, str]] = field(default_factory=set)
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
    """Configurations of a grid with their failures and running launches.

    Attributes
    ----------
    launches
        Launches recorded as running, including dead ones.
    rate
        Trials per second of the living launches over the last minutes.
    detached
        Launches that registered a grid for workers and left.
    explorations
        Explorations that were saved; they count as done or diverged.
    """

    configs: Sequence[ConfigRow]
    failures: Sequence[FailureKind]
    launches: Sequence[LaunchRow]
    rate: float
    explorations: Sequence[ExplorationRow] = ()
    detached: Sequence[LaunchRow] = ()

    @property
    def counts(self) -> Counter[str]:
        """Number of trials in each state."""
        return counts(self.configs)

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


def counts(configs: Iterable[ConfigRow]) -> Counter[str]:
    """Return the number of trials in each state."""
    total = Counter(dict.fromkeys(STATES, 0))
    for config in configs:
        total.update({state: getattr(config, f"n_{state}") for state in STATES})
    return total


def gather(reader: Reader, configs: Sequence[ConfigRow], kinds: int = 10) -> Status:
    """Return the status of the configurations, with tracebacks of the ``kinds`` commonest failures.

    ``reader`` is the snapshot from which ``configs`` were read.
    """
    by_key = {config.config_key: config for config in configs}
    launches = reader.launches()
    running = [launch for launch in launches if launch.state == "running"]
    detached = [launch for launch in launches if DETACHED in launch.overrides]
    failures = _failures(reader, by_key)
    for kind in failures[:kinds]:
        if kind.error_id is not None:
            kind.traceback = str(reader.rows(_TRACEBACK, error_id=kind.error_id)[0][0])
    explored = [one for one in explorations(reader) if one.config_key in by_key]
    return Status(configs, failures, running, _rate(reader, by_key, running), explored, detached)


def _failures(reader: Reader, by_key: dict[str, ConfigRow]) -> list[FailureKind]:
    found: dict[tuple[str, ...], FailureKind] = {}
    for row in reader.rows(_FAILURES):
        if row.config_key in by_key:
            name = (row.cause, row.type or "", _NUMBER.sub("#", row.message or ""))
            new = FailureKind(row.cause, row.type, row.message, row.error_id)
            kind = found.setdefault(name, new)
            kind.attempts += row.attempts
            kind.trials += row.trials
            config = by_key[row.config_key]
            kind.places.add((config.env, config.policy))
    return sorted(found.values(), key=lambda kind: (-kind.trials, -kind.attempts, kind.cause))


def _rate(reader: Reader, by_key: dict[str, ConfigRow], running: Sequence[LaunchRow]) -> float:
    now = datetime.now(UTC)
    ended: Counter[int] = Counter()
    for row in reader.rows(_ENDED, since=utc_text(now - timedelta(seconds=RATE_WINDOW_SECONDS))):
        ended[row.launch_id] += row.ended if row.config_key in by_key else 0
    alive = (launch for launch in running if launch.alive)
    spans = {
        one.launch_id: min(RATE_WINDOW_SECONDS, max(1.0, seconds_since(one.started, now)))
        for one in alive
    }
    return math.fsum(ended[launch_id] / span for launch_id, span in spans.items())


def _counted_seconds(launch: LaunchRow, now: datetime) -> float:
    """Return the part of the rate window in which the launch has run, at least 1 s."""
    return min(RATE_WINDOW_SECONDS, max(1.0, seconds_since(launch.started, now)))


def seconds_since(moment: str, now: datetime) -> float:
    """Return the seconds from a time of the database to ``now``."""
    return (now - datetime.fromisoformat(moment)).total_seconds()
