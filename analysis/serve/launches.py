"""Launches page: the commands that wrote to the database, what became of them, and what failed."""

from __future__ import annotations

import shlex
from datetime import UTC, datetime
from typing import Any

from analysis.serve.progress import read_progress
from analysis.serve.query_params import QueryParams
from analysis.serve.state import ServerState
from orchestrate.store import FailureKind, LaunchRow, failure_kinds

MAX_LAUNCHES = 100
"""Launches on the page, the newest first."""

MAX_KINDS = 20
"""Kinds of failures on the page, the commonest first."""

_OUTCOMES = """
SELECT launch_id, count(*) FILTER (WHERE outcome IN ('done', 'diverged')) AS finished,
       count(*) FILTER (WHERE outcome = 'failed') AS failed
FROM attempt GROUP BY launch_id
"""


def launches(state: ServerState, params: QueryParams) -> dict[str, Any]:  # noqa: ARG001  # the signature is that of every page
    """Return the newest launches with the trials that they ended, and the failures by kind."""
    with state.database.reader().moment() as reader:
        configs = {config.config_key: config for config in reader.configs()}
        failures = failure_kinds(reader, configs, MAX_KINDS)
        found = reader.launches()[::-1]
        outcomes = {int(row[0]): row[1:] for row in reader.rows(_OUTCOMES)}
        progress = read_progress(reader)
    now = datetime.now(UTC)
    return {
        "progress": progress,
        "launches": [
            _launch(one, now)
            | dict(zip(("finished", "failed"), outcomes.get(one.launch_id, (0, 0)), strict=True))
            for one in found[:MAX_LAUNCHES]
        ],
        "total": len(found),
        "failures": [_failure(kind) for kind in failures[:MAX_KINDS]],
        "total_failures": len(failures),
    }


def _launch(launch: LaunchRow, now: datetime) -> dict[str, Any]:
    lost = launch.state == "running" and not launch.alive
    end = now if launch.ended is None else datetime.fromisoformat(launch.ended)
    length = end - datetime.fromisoformat(launch.started)
    return {
        "launch_id": launch.launch_id,
        "kind": launch.kind,
        "state": "lost" if lost else launch.state,
        "started": launch.started,
        "seconds": None if lost else length.total_seconds(),
        "host": launch.host,
        "command": shlex.join(launch.argv),
        "commit": launch.git_commit,
        "changed": bool(launch.git_dirty),
    }


def _failure(kind: FailureKind) -> dict[str, Any]:
    return {
        "cause": kind.cause,
        "type": kind.type,
        "message": kind.message,
        "trials": kind.trials,
        "attempts": kind.attempts,
        "places": [{"env": env, "policy": policy} for env, policy in sorted(kind.places)],
        "traceback": kind.traceback,
    }
