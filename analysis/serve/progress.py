"""Progress of the grid, with tokens that change with the trials and with their samples."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from orchestrate.store import Reader

_TRIALS = """
SELECT status, count(*) AS n, sum(attempt) AS attempts, sum(coalesce(n_steps, 0)) AS steps
FROM trial GROUP BY status ORDER BY status
"""
_LAUNCHES = """
SELECT count(*) AS n, max(launch_id) AS newest, count(*) FILTER (WHERE state = 'running') AS running
FROM launch
"""
_SAMPLES = "SELECT count(*) AS n, coalesce(sum(t), 0) AS steps FROM live_step"


def read_progress(reader: Reader) -> dict[str, Any]:
    """Return the counts of trials by status, and a token that changes when a trial changes.

    ``samples`` changes with each sample of a trial that runs. The queries read the table of trials
    and that of samples once, and no steps.
    """
    trials = [[row.status, *map(int, row[1:])] for row in reader.rows(_TRIALS)]
    (launches,) = reader.rows(_LAUNCHES)
    (samples,) = reader.rows(_SAMPLES)
    content = [trials, list(launches)]
    counts = {status: n for status, n, *_ in trials}
    return {
        "token": hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16],
        "counts": counts,
        "total": sum(counts.values()),
        "ended": sum(n for status, n in counts.items() if status not in ("pending", "running")),
        "running": counts.get("running", 0),
        "launches_running": int(launches.running),
        "samples": f"{samples.n}-{samples.steps}",
    }
