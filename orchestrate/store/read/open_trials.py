"""Trials without an outcome, as workers look for them: by configuration, one after the other.

A worker looks for trials that a launch with the fingerprint of its own has registered.
"""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, text

from orchestrate.store.serialization import stored_json


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


_ALIKE = (
    "registered_by IN (SELECT l.launch_id FROM launch l JOIN launch m "
    "ON coalesce(m.fingerprint, '') = coalesce(l.fingerprint, '') WHERE m.launch_id = :launch)"
)
_CONFIGS = text(
    "SELECT c.config_id, c.config_key, c.config_json, s.pending, s.running, s.mean, s.longest "
    f"FROM (SELECT config_id, count(*) FILTER (WHERE status = 'pending' AND {_ALIKE}) AS pending, "
    f"count(*) FILTER (WHERE status = 'running' AND {_ALIKE}) AS running, "
    "avg(wall_seconds) FILTER (WHERE status IN ('done', 'diverged')) AS mean, "
    "max(wall_seconds) FILTER (WHERE status IN ('done', 'diverged')) AS longest "
    "FROM trial GROUP BY config_id) AS s JOIN config c ON c.config_id = s.config_id "
    "WHERE s.pending + s.running > 0 ORDER BY c.config_id"
)
_OTHERS = text(
    "SELECT l.fingerprint, count(*) FROM trial r LEFT JOIN launch l "
    "ON l.launch_id = r.registered_by WHERE r.status IN ('pending', 'running') "
    f"AND (r.registered_by IS NULL OR NOT r.{_ALIKE}) GROUP BY l.fingerprint ORDER BY 2 DESC"
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
    f"WHERE p.config_id = :config_id AND p.status = 'pending' AND p.{_ALIKE} "
    f"AND (p.attempt < :losses OR {_attempts('p', _LOST)} < :losses) "
    "ORDER BY random() LIMIT :size)"
)
_SUSPECTS = text(
    f"SELECT r.trial_key, r.config_id, r.seed, 0 AS crashes, {_attempts('r', _LONE)} AS lone "
    f"FROM trial r WHERE r.status = 'pending' AND r.attempt >= :losses AND r.{_ALIKE} "
    f"AND {_attempts('r', _LOST)} >= :losses ORDER BY r.attempt, r.trial_id"
)


def open_configs(connection: Connection, launch: int) -> list[OpenConfig]:
    """Return the configurations that have trials without an outcome for the code of a launch."""
    return [OpenConfig(*row) for row in connection.execute(_CONFIGS, {"launch": launch})]


def others(connection: Connection, launch: int) -> list[tuple[dict[str, str] | None, int]]:
    """Return the fingerprints of other code that registered trials without an outcome, and counts.

    The fingerprint of an older program is None.
    """
    rows = connection.execute(_OTHERS, {"launch": launch})
    return [(stored and stored_json(stored, dict), count) for stored, count in rows]


def open_trials(
    connection: Connection, launch: int, config_id: int, size: int, losses: int
) -> list[OpenTrial]:
    """Return some pending trials of a configuration that lost fewer launches than ``losses``."""
    given = {"launch": launch, "config_id": config_id, "size": size, "losses": losses}
    return [OpenTrial(*row) for row in connection.execute(_TRIALS, given)]


def suspects(connection: Connection, launch: int, losses: int) -> list[OpenTrial]:
    """Return the pending trials whose launch was lost at least ``losses`` times."""
    given = {"launch": launch, "losses": losses}
    return [OpenTrial(*row) for row in connection.execute(_SUSPECTS, given)]
