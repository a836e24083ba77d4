"""Views for SQL users, in SQL that SQLite and PostgreSQL both accept."""

from __future__ import annotations

from orchestrate.store.schema import OUTCOME_COLUMNS

_CONFIG = "c.config_key, c.label, c.env, c.policy, c.model, c.learner, c.width, c.depth"

_OUTCOME = ", ".join(f"r.{name}" for name in OUTCOME_COLUMNS)

_TRIAL = f"""
SELECT {_CONFIG}, c.horizon, c.dt, c.gamma,
       r.seed, r.trial_id, r.trial_key, r.status, r.attempt, {_OUTCOME}, r.launch_id,
       e.type AS error_type, e.message AS error_message
FROM trial r
JOIN config c ON c.config_id = r.config_id
LEFT JOIN error e ON e.error_id = r.error_id
"""

# SQLite keeps the order of a CROSS JOIN: it would read the steps of all configurations otherwise.
_CURVE = f"""
SELECT {_CONFIG}, r.seed, s.t, s.loss, s.reachable_loss
FROM config c CROSS JOIN trial r CROSS JOIN step s
WHERE r.config_id = c.config_id AND s.trial_id = r.trial_id
"""

# One pass is exact enough: losses of different seeds differ by far more than 1e-6 of their mean,
# so cancellation in the variance costs less than 1e-3 of the error. The outer CASE keeps rounding
# from making the variance of equal losses negative. The square of a loss above 1e150 overflows,
# for which PostgreSQL refuses the whole query: such losses, of diverging models, have no error.
_CURVE_STATS = """
SELECT config_key, label, env, policy, model, learner, width, depth, t, n, n_finite, mean,
       CASE WHEN n_finite < 2 OR n_squares < n_finite THEN NULL
            WHEN squares <= n_finite * mean * mean THEN 0.0
            ELSE sqrt((squares - n_finite * mean * mean) / (n_finite - 1) / n_finite)
       END AS standard_error
FROM (SELECT config_key, label, env, policy, model, learner, width, depth, t,
             count(*) AS n, count(loss) AS n_finite, avg(loss) AS mean,
             count(CASE WHEN abs(loss) < 1e150 THEN 1 END) AS n_squares,
             sum(CASE WHEN abs(loss) < 1e150 THEN loss * loss END) AS squares
      FROM v_curve
      GROUP BY config_key, label, env, policy, model, learner, width, depth, t) AS sums
"""


def _count(status: str) -> str:
    return f"count(*) FILTER (WHERE r.status = '{status}') AS n_{status}"


_COUNTS = ",\n       ".join(
    _count(status) for status in ("done", "diverged", "failed", "cancelled", "pending", "running")
)

_PROGRESS = f"""
SELECT {_CONFIG}, c.horizon, c.dt, c.gamma, count(*) AS n,
       {_COUNTS}
FROM config c
JOIN trial r ON r.config_id = c.config_id
GROUP BY c.config_id, {_CONFIG}, c.horizon, c.dt, c.gamma
"""

_FAILURES = f"""
SELECT {_CONFIG}, r.seed, r.trial_key, r.status, a.attempt, a.launch_id, a.node, a.ended,
       a.cause, e.type, e.message, e.traceback
FROM attempt a
JOIN error e ON e.error_id = a.error_id
JOIN trial r ON r.trial_id = a.trial_id
JOIN config c ON c.config_id = r.config_id
"""

_ASSESSMENT = f"""
SELECT {_CONFIG}, c.horizon, r.seed, r.trial_key, r.status, a.t, a.measure, a.value
FROM config c
JOIN trial r ON r.config_id = c.config_id
JOIN assessment a ON a.trial_id = r.trial_id
"""

# In the order of creation.
VIEWS = {
    "v_trial": _TRIAL,
    "v_curve": _CURVE,
    "v_curve_stats": _CURVE_STATS,
    "v_progress": _PROGRESS,
    "v_failures": _FAILURES,
    "v_assessment": _ASSESSMENT,
}
