"""Content of a database, row by row, and its invariants at every moment."""

from __future__ import annotations

from typing import Any

from orchestrate.store import Reader

Rows = dict[str, list[tuple[Any, ...]]]

_RESULTS = {
    "summary": "SELECT seed, trial_key, status, n_steps, final_loss, best_loss, diverged_at "
    "FROM trial ORDER BY seed",
    "curve": "SELECT r.seed, s.t, s.loss, s.reachable_loss, s.plan_us, s.learn_us, s.evaluate_us "
    "FROM step s JOIN trial r ON r.trial_id = s.trial_id ORDER BY r.seed, s.t",
    "trajectory": "SELECT r.seed, p.dtype, p.states_shape, p.states, p.inputs_shape, p.inputs, "
    "p.parameters_shape, p.parameters "
    "FROM trajectory p JOIN trial r ON r.trial_id = p.trial_id ORDER BY r.seed",
    "assessment": "SELECT r.seed, a.t, a.measure, a.value "
    "FROM assessment a JOIN trial r ON r.trial_id = a.trial_id ORDER BY r.seed, a.t, a.measure",
}

_FINISHED = "r.status IN ('done', 'diverged')"
_STEPS = "(SELECT count(*) FROM step s WHERE s.trial_id = r.trial_id)"
_TRAJECTORIES = "(SELECT count(*) FROM trajectory p WHERE p.trial_id = r.trial_id)"
_ASSESSMENTS = "(SELECT count(*) FROM assessment b WHERE b.trial_id = r.trial_id)"
_MOST = (
    "(SELECT coalesce(max(n), 0) FROM (SELECT count(*) AS n FROM assessment GROUP BY trial_id) k)"
)
_ATTEMPTS = "(SELECT count(*) FROM attempt a WHERE a.trial_id = r.trial_id)"
_WITH_ATTEMPTS = "trial r JOIN attempt a ON a.trial_id = r.trial_id"

_FLAWS = {
    "has part of a curve": "SELECT r.seed FROM trial r JOIN config c ON c.config_id = r.config_id "
    f"WHERE {_STEPS} <> CASE WHEN {_FINISHED} THEN c.horizon ELSE 0 END",
    "has not one trajectory for its curve": "SELECT r.seed FROM trial r "
    f"WHERE {_TRAJECTORIES} <> CASE WHEN {_FINISHED} THEN 1 ELSE 0 END",
    "has part of an assessment": "SELECT r.seed FROM trial r "
    f"WHERE {_ASSESSMENTS} <> CASE WHEN {_FINISHED} THEN {_MOST} ELSE 0 END",
    "was finished twice": f"SELECT r.seed FROM {_WITH_ATTEMPTS} "
    "WHERE a.outcome IN ('done', 'diverged') GROUP BY r.seed HAVING count(*) > 1",
    "has attempts that nobody counted": "SELECT r.seed FROM trial r "
    f"WHERE r.attempt <> {_ATTEMPTS}",
    "has an outcome that its last attempt does not have": f"SELECT r.seed FROM {_WITH_ATTEMPTS} "
    "WHERE a.attempt = r.attempt AND r.status IN ('done', 'diverged', 'failed') "
    "AND (a.outcome IS NULL OR a.outcome <> r.status)",
    "has an earlier attempt without an end": f"SELECT r.seed FROM {_WITH_ATTEMPTS} "
    "WHERE a.attempt < r.attempt AND (a.outcome IS NULL OR a.ended IS NULL "
    "OR a.outcome NOT IN ('lost', 'released', 'failed'))",
    "was claimed before its earlier attempt ended": "SELECT r.seed FROM trial r "
    "JOIN attempt a ON a.trial_id = r.trial_id "
    "JOIN attempt b ON b.trial_id = a.trial_id AND b.attempt = a.attempt + 1 "
    "WHERE b.claimed < a.ended",
    "is owned though it does not run": "SELECT r.seed FROM trial r "
    "WHERE (r.status = 'running') <> (r.owner IS NOT NULL)",
}


def results(url: str, but: int | None = None) -> Rows:
    """Return everything that the trials left, without times and places, by seed.

    ``but`` is the seed of a trial to leave out.
    """
    with Reader.open(url) as reader:
        return {
            name: [tuple(row) for row in reader.rows(sql) if row[0] != but]
            for name, sql in _RESULTS.items()
        }


def flaws(url: str) -> list[str]:
    """Return what is wrong with the database, one sentence for each trial."""
    with Reader.open(url) as reader:
        return [
            f"the trial with seed {row[0]} {flaw}"
            for flaw, sql in _FLAWS.items()
            for row in reader.rows(sql)
        ]
