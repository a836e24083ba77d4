"""Answers about a results database: progress of a grid, one trial, columns of configurations."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from dopt.limits import VIOLATIONS, WORST
from dopt.spec.config import completed
from dopt.spec.label import limits_label
from orchestrate.errors import without_password
from orchestrate.store import (
    ConfigRow,
    ExplorationRow,
    FailureKind,
    LaunchRow,
    Reader,
    explorations,
    failure_kinds,
)
from orchestrate.store.records import stored_json, utc_text

RATE_WINDOW_SECONDS = 300.0
"""Period over which the rate is averaged."""

STATES = ("done", "diverged", "failed", "cancelled", "running", "pending")
"""Statuses of a trial in the order of display."""

_ENDED = """
SELECT c.config_key, a.launch_id, count(*) AS ended
FROM attempt a
JOIN trial r ON r.trial_id = a.trial_id
JOIN config c ON c.config_id = r.config_id
WHERE a.ended >= :since AND a.outcome IN ('done', 'diverged', 'failed')
GROUP BY c.config_key, a.launch_id
"""


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
    mixed
        Keys of configurations whose finished trials were run by different code.
    explorations
        Explorations that were saved; they count as done or diverged.
    """

    configs: Sequence[ConfigRow]
    failures: Sequence[FailureKind]
    launches: Sequence[LaunchRow]
    rate: float
    explorations: Sequence[ExplorationRow] = ()
    detached: Sequence[LaunchRow] = ()
    mixed: Sequence[str] = ()

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
    detached = [launch for launch in launches if launch.kind == "registration"]
    failures = failure_kinds(reader, by_key, kinds)
    explored = [one for one in explorations(reader) if one.config_key in by_key]
    mixed = [key for key in reader.mixed_code() if key in by_key]
    rate = _rate(reader, by_key, running)
    return Status(configs, failures, running, rate, explored, detached, mixed)


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


def seconds_since(moment: str, now: datetime) -> float:
    """Return the seconds from a time of the database to ``now``."""
    return (now - datetime.fromisoformat(moment)).total_seconds()


_TRIAL = "SELECT * FROM v_trial WHERE trial_id = :trial_id"
_CONFIG = "SELECT config_json FROM config WHERE config_key = :config_key"
_ATTEMPTS = """
SELECT a.attempt, a.launch_id, a.outcome, a.cause, a.node, a.pid, a.claimed, a.started, a.ended,
       a.wall_seconds, a.cpu_seconds, a.peak_memory_bytes, e.type, e.message, e.traceback
FROM attempt a
LEFT JOIN error e ON e.error_id = a.error_id
WHERE a.trial_id = :trial_id
ORDER BY a.attempt
"""
_LOSS = "SELECT loss FROM step WHERE trial_id = :trial_id ORDER BY t"
_BEYOND = f"""
SELECT measure, value FROM assessment
WHERE trial_id = :trial_id AND measure IN ('{VIOLATIONS}', '{WORST}') ORDER BY t, measure
"""


@dataclass(frozen=True)
class TrialReport:
    """Contents of the database about one trial.

    Attributes
    ----------
    trial
        Row of ``v_trial``.
    config
        The whole configuration without the seed.
    launches
        The launches that ran it, without passwords.
    attempts
        One for each claim, with its error if there was one.
    loss
        The loss curve, with None for values that are not finite; empty without one.
    beyond_limits
        ``violations`` and ``worst`` of a trial with limits (:data:`dopt.assessment.MEASURES`).
    exploration
        Steps of an exploration, and whether it goes on; None for another trial.
    """

    trial: Mapping[str, Any]
    config: Mapping[str, Any]
    launches: Sequence[Mapping[str, Any]]
    attempts: Sequence[Mapping[str, Any]]
    loss: Sequence[float | None]
    beyond_limits: Mapping[str, float | None]
    exploration: ExplorationRow | None = None


def report(reader: Reader, trial_id: int) -> TrialReport:
    """Return the report of a trial; ``reader`` is a snapshot."""
    trial = reader.rows(_TRIAL, trial_id=trial_id)[0]._asdict()
    attempts = [row._asdict() for row in reader.rows(_ATTEMPTS, trial_id=trial_id)]
    tried = {attempt["launch_id"] for attempt in attempts}
    ((text,),) = reader.rows(_CONFIG, config_key=trial["config_key"])
    return TrialReport(
        trial=trial,
        config=completed(stored_json(text, dict)),
        launches=[
            {name: _public(value) for name, value in asdict(launch).items()}
            for launch in reader.launches()
            if launch.launch_id in tried
        ],
        attempts=attempts,
        loss=[row[0] for row in reader.rows(_LOSS, trial_id=trial_id)],
        beyond_limits={row[0]: row[1] for row in reader.rows(_BEYOND, trial_id=trial_id)},
        exploration=next(
            (one for one in explorations(reader) if one.trial_key == trial["trial_key"]), None
        ),
    )


def _public(value: Any) -> Any:
    return [without_password(word) for word in value] if isinstance(value, list) else value


COLUMNS = (
    *("env", "policy", "model", "learner", "width", "depth", "horizon", "dt", "gamma", "task"),
    "limits",
)


def column_text(config: ConfigRow, name: str) -> str:
    """Return the value of a column; "-" where the configuration has none."""
    if name == "limits":
        return limits_label(config.config) or "-"
    value = _task(config) if name == "task" else getattr(config, name)
    return "-" if value is None else str(value)


def differing(configs: Sequence[ConfigRow], always: Sequence[str] = ()) -> list[str]:
    """Return the columns that ``always`` names or that have several values, in their order."""
    return [
        name
        for name in COLUMNS
        if name in always or len({column_text(config, name) for config in configs}) > 1
    ]


def _task(config: ConfigRow) -> object:
    task = config.config.get("task")
    return task.get("name") if isinstance(task, Mapping) else task
