"""Failures of a database, with those together that ended alike."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from orchestrate.store.read.reader import Reader
from orchestrate.store.read.rows import ConfigRow

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


def failure_kinds(
    reader: Reader, configs: Mapping[str, ConfigRow], tracebacks: int
) -> list[FailureKind]:
    """Return the failures of the configurations, given by key, the commonest kind first.

    The commonest ``tracebacks`` kinds have the traceback of one of their attempts.
    """
    found: dict[tuple[str, ...], FailureKind] = {}
    for row in reader.rows(_FAILURES):
        if row.config_key in configs:
            name = (row.cause, row.type or "", _NUMBER.sub("#", row.message or ""))
            new = FailureKind(row.cause, row.type, row.message, row.error_id)
            kind = found.setdefault(name, new)
            kind.attempts += row.attempts
            kind.trials += row.trials
            config = configs[row.config_key]
            kind.places.add((config.env, config.policy))
    kinds = sorted(found.values(), key=lambda kind: (-kind.trials, -kind.attempts, kind.cause))
    for kind in kinds[:tracebacks]:
        if kind.error_id is not None:
            kind.traceback = str(reader.rows(_TRACEBACK, error_id=kind.error_id)[0][0])
    return kinds
