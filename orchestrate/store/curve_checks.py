"""What must hold between a trial and its steps, in one pass over all of them."""

from __future__ import annotations

from orchestrate.store.findings import Finding, found
from orchestrate.store.reader import Reader
from orchestrate.store.row_checks import FINISHED, NAME, REBUILD, not_finite
from orchestrate.store.schema import STEP_VALUES

_END = "coalesce(r.diverged_at, c.horizon)"  # the first step without a loss

_BROKEN = {
    "finished trials without one step for each t below their horizon": f"{FINISHED} AND "
    "(s.n IS NULL OR s.n <> c.horizon OR s.low <> 0 OR s.high <> c.horizon - 1)",
    "finished trials that lack a loss before they diverged or ended, or have one after that": (
        f"{FINISHED} AND (s.n_loss <> {_END} OR s.last >= {_END})"
    ),
    "done trials with another final loss than that of their last step": (
        "r.status = 'done' AND (r.final_loss IS NULL OR r.final_loss <> e.loss)"
    ),
    "trials without a result but with steps": f"NOT {FINISHED} AND s.n > 0",
    "trials with steps that hold a number that is not finite, not NULL": "s.infinite > 0",
}
_FLAGS = [
    f"CASE WHEN {what} THEN 1 ELSE 0 END AS flag_{i}" for i, what in enumerate(_BROKEN.values())
]
_SUM = " + ".join(f"flag_{i}" for i in range(len(_FLAGS)))
_SQL = f"""
SELECT * FROM (
    SELECT r.trial_id, {NAME} AS name, {", ".join(_FLAGS)}
    FROM trial r
    JOIN config c ON c.config_id = r.config_id
    LEFT JOIN (SELECT trial_id, count(*) AS n, min(t) AS low, max(t) AS high,
                      count(loss) AS n_loss, max(CASE WHEN loss IS NOT NULL THEN t END) AS last,
                      sum(CASE WHEN {not_finite("s", STEP_VALUES)} THEN 1 ELSE 0 END) AS infinite
               FROM step s GROUP BY trial_id) s ON s.trial_id = r.trial_id
    LEFT JOIN step e ON e.trial_id = r.trial_id AND e.t = c.horizon - 1) AS flagged
WHERE {_SUM} > 0 ORDER BY trial_id
"""


def broken_curves(moment: Reader) -> list[Finding]:
    """Find curves that are partial, stray, or do not agree with the summary of their trial."""
    rows = moment.rows(_SQL)
    findings = []
    for column, what in enumerate(_BROKEN, start=2):
        names = [row[1] for row in rows if row[column]]
        if names:
            findings.append(found("error", what, len(names), names[0], REBUILD))
    return findings
