"""Check of results: each finished trial has all its rows, each other trial has none."""

from __future__ import annotations

from orchestrate.store.doctor.findings import REBUILD, Finding, found
from orchestrate.store.read.reader import Reader
from orchestrate.store.schema import N_ROWS, PREQUENTIAL, STEP_VALUES

_NAME = (
    "c.env || ' ' || c.policy || ' seed ' || r.seed || ' (' || substr(r.trial_key, 1, 12) || ')'"
)
_FINISHED = "r.status IN ('done', 'diverged')"
_END = f"coalesce(r.diverged_at, {N_ROWS})"  # the first step without a loss
_LARGEST = "1.7976931348623157e308"  # NaN is larger in PostgreSQL, and NULL in SQLite


def _not_finite(table: str, *columns: str) -> str:
    return " OR ".join(f"abs({table}.{column}) > {_LARGEST}" for column in columns)


_CONDITIONS = {
    "finished trials without one step for each t below their horizon": (
        f"{_FINISHED} AND (s.n IS NULL OR s.n <> {N_ROWS} OR s.low <> 0 OR s.high <> {N_ROWS} - 1)"
    ),
    "finished trials that lack a loss before they diverged or ended, or have one after that": (
        f"{_FINISHED} AND (s.n_loss <> {_END} OR s.last >= {_END})"
    ),
    "done trials whose final loss differs from the loss of their last step": (
        "r.status = 'done' AND (r.final_loss IS NULL OR r.final_loss <> e.loss)"
    ),
    "finished trials without a trajectory": f"{_FINISHED} AND p.trial_id IS NULL",
    "done trials that lack assessments": (
        f"r.status = 'done' AND c.config_json NOT LIKE '{PREQUENTIAL}' "
        "AND (coalesce(a.n, 0) <> coalesce(m.most, 0) "
        """OR (a.n IS NULL AND (c.config_json LIKE '%"task":{%' """
        """OR c.config_json LIKE '%"limits":{%')))"""
    ),
    "unfinished trials with steps, a trajectory or assessments": (
        f"NOT {_FINISHED} AND (s.n > 0 OR p.trial_id IS NOT NULL OR a.n > 0)"
    ),
    "trials with a number that is not finite, where NULL is expected": (
        f"s.infinite > 0 OR a.infinite > 0 OR {_not_finite('r', 'final_loss', 'best_loss')}"
    ),
}
_FLAGS = [
    f"CASE WHEN {condition} THEN 1 ELSE 0 END AS flag_{i}"
    for i, condition in enumerate(_CONDITIONS.values())
]
_SUM = " + ".join(f"flag_{i}" for i in range(len(_FLAGS)))
_STEPS = f"""
SELECT trial_id, count(*) AS n, min(t) AS low, max(t) AS high, count(loss) AS n_loss,
       max(CASE WHEN loss IS NOT NULL THEN t END) AS last,
       sum(CASE WHEN {_not_finite("s", *STEP_VALUES)} THEN 1 ELSE 0 END) AS infinite
FROM step s GROUP BY trial_id
"""
_ASSESSMENTS = f"""
SELECT trial_id, count(*) AS n,
       sum(CASE WHEN {_not_finite("a", "value")} THEN 1 ELSE 0 END) AS infinite
FROM assessment a GROUP BY trial_id
"""
_EXPECTED_ASSESSMENTS = """
SELECT o.config_id, max(n) AS most
FROM (SELECT trial_id, count(*) AS n FROM assessment GROUP BY trial_id) counted
JOIN trial o ON o.trial_id = counted.trial_id WHERE o.status = 'done' GROUP BY o.config_id
"""
_SQL = f"""
SELECT * FROM (
    SELECT r.trial_id, {_NAME} AS name, {", ".join(_FLAGS)}
    FROM trial r
    JOIN config c ON c.config_id = r.config_id
    LEFT JOIN ({_STEPS}) s ON s.trial_id = r.trial_id
    LEFT JOIN step e ON e.trial_id = r.trial_id AND e.t = {N_ROWS} - 1
    LEFT JOIN trajectory p ON p.trial_id = r.trial_id
    LEFT JOIN ({_ASSESSMENTS}) a ON a.trial_id = r.trial_id
    LEFT JOIN ({_EXPECTED_ASSESSMENTS}) m ON m.config_id = r.config_id) AS flagged
WHERE {_SUM} > 0 ORDER BY trial_id
"""


def incomplete_results(moment: Reader) -> list[Finding]:
    """Return a finding for each condition that some trials meet."""
    rows = moment.rows(_SQL)
    findings = []
    for column, condition in enumerate(_CONDITIONS, start=2):
        names = [row[1] for row in rows if row[column]]
        if names:
            findings.append(found("error", condition, len(names), names[0], REBUILD))
    return findings
