"""Trials without an outcome, as workers look for them: by configuration, one after the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sqlalchemy import Connection, text


@dataclass(frozen=True)
class OpenConfig:
    """Configuration with trials that have no outcome.

    Attributes
    ----------
    pending, running
        Number of its trials that wait, and that a launch has claimed.
    mean_seconds, max_seconds
        Wall time of its finished trials; None if there is none.
    """

    config_id: int
    config_key: str
    config_json: str
    pending: int
    running: int
    mean_seconds: float | None
    max_seconds: float | None


@dataclass(frozen=True)
class OpenTrial:
    """Pending trial.

    Attributes
    ----------
    crashes
        Deaths of a process that ran it, or ran it in one chunk with others, as a living launch saw.
    lone_losses
        Losses of a whole launch that held this trial and no other; counted for suspects only.
    """

    trial_key: str
    config_id: int
    seed: int
    crashes: int
    lone_losses: int = 0


_CONFIGS = text(
    "SELECT c.config_id, c.config_key, c.config_json, s.pending, s.running, s.mean, s.longest "
    "FROM (SELECT config_id, count(*) FILTER (WHERE status = 'pending') AS pending, "
    "count(*) FILTER (WHERE status = 'running') AS running, "
    "avg(wall_seconds) FILTER (WHERE status IN ('done', 'diverged')) AS mean, "
    "max(wall_seconds) FILTER (WHERE status IN ('done', 'diverged')) AS longest "
    "FROM trial GROUP BY config_id) AS s JOIN config c ON c.config_id = s.config_id "
    "WHERE s.pending + s.running > 0 ORDER BY c.config_id"
)


def _attempts(trial: str, condition: str) -> str:
    """Return SQL that counts the attempts of a trial since it last failed."""
    failed = (
        "coalesce((SELECT max(f.attempt) FROM attempt f "
        f"WHERE f.trial_id = {trial}.trial_id AND f.outcome = 'failed'), 0)"
    )
    return (
        f"(SELECT count(*) FROM attempt a WHERE a.trial_id = {trial}.trial_id "
        f"AND a.attempt > {failed} AND {condition})"
    )


_LOST = "a.outcome = 'lost'"
# A query of its own that refers to no trial, so that it is carried out once.
_LONE = (
    f"{_LOST} AND a.launch_id IN (SELECT b.launch_id FROM attempt b WHERE b.outcome = 'lost' "
    "GROUP BY b.launch_id HAVING min(b.trial_id) = max(b.trial_id))"
)
_CRASHES = _attempts("r", "a.cause IN ('killed', 'out of memory')")

# Trials that were never claimed, nearly all of them, need no look at their attempts. Workers that
# look at the same time see different trials first.
_TRIALS = text(
    f"SELECT r.trial_key, r.config_id, r.seed, {_CRASHES} AS crashes FROM trial r "
    "WHERE r.trial_id IN (SELECT p.trial_id FROM trial p "
    "WHERE p.config_id = :config_id AND p.status = 'pending' "
    f"AND (p.attempt < :losses OR {_attempts('p', _LOST)} < :losses) "
    "ORDER BY random() LIMIT :size)"
)
_SUSPECTS = text(
    f"SELECT r.trial_key, r.config_id, r.seed, 0 AS crashes, {_attempts('r', _LONE)} AS lone "
    "FROM trial r WHERE r.status = 'pending' AND r.attempt >= :losses "
    f"AND {_attempts('r', _LOST)} >= :losses ORDER BY r.attempt, r.trial_id"
)


def open_configs(connection: Connection) -> list[OpenConfig]:
    """Return the configurations that have trials without an outcome."""
    return [OpenConfig(*row) for row in connection.execute(_CONFIGS)]


def open_trials(connection: Connection, config_id: int, size: int, losses: int) -> list[OpenTrial]:
    """Return some pending trials of a configuration that lost fewer launches than ``losses``."""
    given: Mapping[str, int] = {"config_id": config_id, "size": size, "losses": losses}
    return [OpenTrial(*row) for row in connection.execute(_TRIALS, given)]


def suspects(connection: Connection, losses: int) -> list[OpenTrial]:
    """Return the pending trials whose launch was lost at least ``losses`` times."""
    return [OpenTrial(*row) for row in connection.execute(_SUSPECTS, {"losses": losses})]
