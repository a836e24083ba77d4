"""What must hold between the rows of a database, as queries for those that break it."""

from __future__ import annotations

from dataclasses import dataclass

from orchestrate.store.findings import Finding, Severity, found
from orchestrate.store.reader import Reader

REBUILD = (
    "merge this database into a new one, which leaves such trials out (python -m orchestrate merge "
    "THIS --db NEW), and run the same launch into that one"
)
# NaN is the largest number for PostgreSQL, and NULL for SQLite.
_LARGEST = "1.7976931348623157e308"


@dataclass(frozen=True)
class Check:
    """A query for rows that should not be there.

    Attributes
    ----------
    what
        Who they are, in the plural.
    sql
        Returns one row for each, its first column a name to show.
    """

    severity: Severity
    what: str
    advice: str
    sql: str

    def findings(self, moment: Reader) -> list[Finding]:
        rows = moment.rows(self.sql)
        if not rows:
            return []
        return [found(self.severity, self.what, len(rows), rows[0][0], self.advice)]


NAME = "c.env || ' ' || c.policy || ' seed ' || r.seed || ' (' || substr(r.trial_key, 1, 12) || ')'"
_TRIAL = f"SELECT {NAME} FROM trial r JOIN config c ON c.config_id = r.config_id"
FINISHED = "r.status IN ('done', 'diverged')"


def not_finite(table: str, columns: tuple[str, ...]) -> str:
    return " OR ".join(f"abs({table}.{column}) > {_LARGEST}" for column in columns)


CHECKS = (
    Check(
        "error",
        "finished trials without a trajectory",
        REBUILD,
        f"{_TRIAL} WHERE {FINISHED} AND NOT EXISTS "
        "(SELECT 1 FROM trajectory p WHERE p.trial_id = r.trial_id) ORDER BY r.trial_id",
    ),
    Check(
        "error",
        "trials without a result but with a trajectory",
        REBUILD,
        f"{_TRIAL} WHERE NOT {FINISHED} AND EXISTS "
        "(SELECT 1 FROM trajectory p WHERE p.trial_id = r.trial_id) ORDER BY r.trial_id",
    ),
    Check(
        "error",
        "trials with a number that is not finite, where NULL is expected",
        REBUILD,
        f"{_TRIAL} WHERE {not_finite('r', ('final_loss', 'best_loss'))} ORDER BY r.trial_id",
    ),
    Check(
        "error",
        "trials without a result but with an assessment",
        REBUILD,
        f"{_TRIAL} WHERE NOT {FINISHED} AND EXISTS "
        "(SELECT 1 FROM assessment a WHERE a.trial_id = r.trial_id) ORDER BY r.trial_id",
    ),
    Check(
        "error",
        "done trials that lack some of the assessments of their configuration",
        REBUILD,
        f"{_TRIAL} LEFT JOIN (SELECT trial_id, count(*) AS n FROM assessment GROUP BY trial_id) a "
        "ON a.trial_id = r.trial_id "
        "JOIN (SELECT s.config_id, max(s.n) AS most FROM (SELECT o.config_id, count(*) AS n "
        "FROM assessment b JOIN trial o ON o.trial_id = b.trial_id WHERE o.status = 'done' "
        "GROUP BY o.config_id, o.trial_id) s GROUP BY s.config_id) m ON m.config_id = r.config_id "
        "WHERE r.status = 'done' AND coalesce(a.n, 0) <> m.most ORDER BY r.trial_id",
    ),
    Check(
        "error",
        "done trials with a task but without an assessment",
        REBUILD,
        f"""{_TRIAL} WHERE r.status = 'done' AND c.config_json LIKE '%"task":{{%' """
        "AND NOT EXISTS (SELECT 1 FROM assessment a WHERE a.trial_id = r.trial_id) "
        "ORDER BY r.trial_id",
    ),
    Check(
        "error",
        "trials with an assessment that is not finite, not NULL",
        REBUILD,
        f"{_TRIAL} WHERE EXISTS (SELECT 1 FROM assessment a WHERE a.trial_id = r.trial_id "
        f"AND {not_finite('a', ('value',))}) ORDER BY r.trial_id",
    ),
    Check(
        "error",
        "trials that run without an owner, or have one and do not run",
        REBUILD,
        f"{_TRIAL} WHERE (r.status = 'running') <> (r.owner IS NOT NULL) ORDER BY r.trial_id",
    ),
    Check(
        "warning",
        "attempts without an outcome at trials that do not run",
        "nothing that the results depend on; the record of these attempts is incomplete",
        f"SELECT {NAME} FROM attempt a JOIN trial r ON r.trial_id = a.trial_id "
        "JOIN config c ON c.config_id = r.config_id "
        "WHERE a.outcome IS NULL AND (r.status <> 'running' OR a.attempt <> r.attempt) "
        "ORDER BY a.trial_id",
    ),
    Check(
        "note",
        "errors of no trial and no attempt",
        "nothing: they take room and do no harm",
        "SELECT e.type || ': ' || e.message FROM error e "
        "WHERE NOT EXISTS (SELECT 1 FROM trial r WHERE r.error_id = e.error_id) "
        "AND NOT EXISTS (SELECT 1 FROM attempt a WHERE a.error_id = e.error_id) "
        "ORDER BY e.error_id",
    ),
    Check(
        "note",
        "configurations without a trial",
        "nothing: they take room and do no harm",
        "SELECT c.env || ' ' || c.policy || ' (' || substr(c.config_key, 1, 12) || ')' "
        "FROM config c WHERE NOT EXISTS "
        "(SELECT 1 FROM trial r WHERE r.config_id = c.config_id) ORDER BY c.config_id",
    ),
)
