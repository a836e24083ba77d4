"""The outcome of an attempt: written whole, in one transaction, by the launch that owns it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import (
    Connection,
    Integer,
    bindparam,
    insert,
    literal_column,
    select,
    text,
    update,
)

from orchestrate.passwords import without_password
from orchestrate.store.backend import Backend
from orchestrate.store.checking import check_horizon, check_result
from orchestrate.store.packing import DTYPE, pack
from orchestrate.store.records import Array, Claim, Failure, Result, RunRecord
from orchestrate.store.schema import (
    STEP_VALUES,
    assessment,
    attempt,
    error,
    trajectory,
    trial,
)
from orchestrate.store.values import finite, plain, storable, utc_text

_RUN_COLUMNS = ("node", "wall_seconds", "cpu_seconds", "peak_memory_bytes")

# As text, because SQLAlchemy leaves table names out of RETURNING on SQLite, and a bare config_id
# would be that of the inner table.
_HORIZON = literal_column(
    "(SELECT config.horizon FROM config WHERE config.config_id = trial.config_id)", Integer
)

# The fence: only the launch that still owns this very attempt may write.
_FENCED = (
    update(trial)
    .where(
        trial.c.trial_id == bindparam("fence_trial"),
        trial.c.owner == bindparam("fence_owner"),
        trial.c.attempt == bindparam("fence_attempt"),
        trial.c.status == "running",
    )
    .values(
        status=bindparam("status"),
        owner=None,
        launch_id=bindparam("fence_owner"),
        n_steps=bindparam("n_steps"),
        final_loss=bindparam("final_loss"),
        best_loss=bindparam("best_loss"),
        diverged_at=bindparam("diverged_at"),
        error_id=None,
        **{name: bindparam(name) for name in _RUN_COLUMNS},
    )
    .returning(_HORIZON)
)
_END_ATTEMPT = (
    update(attempt)
    .where(
        attempt.c.trial_id == bindparam("fence_trial"),
        attempt.c.attempt == bindparam("fence_attempt"),
    )
    .values(
        outcome=bindparam("status"),
        cause=bindparam("cause"),
        error_id=bindparam("error_id"),
        **{name: bindparam(name) for name in (*_RUN_COLUMNS, "pid", "started", "ended")},
    )
)
_SET_ERROR = (
    update(trial)
    .where(trial.c.trial_id == bindparam("fence_trial"))
    .values(error_id=bindparam("error_id"))
)
_INSERT_TRAJECTORY = insert(trajectory)
_INSERT_ASSESSMENT = insert(assessment)
_INSERT_ERROR = text(
    "INSERT INTO error (hash, type, message, traceback) "
    "VALUES (:hash, :type, :message, :traceback) ON CONFLICT (hash) DO NOTHING"
)
_ERROR_ID = select(error.c.error_id).where(error.c.hash == bindparam("hash"))


@dataclass(frozen=True)
class Outcome:
    """Rows of a finished trial, made before the transaction to keep that one short."""

    claim: Claim
    summary: dict[str, Any]
    steps: Array
    trajectory: dict[str, Any]
    assessments: list[dict[str, Any]]


def prepare(claim: Claim, result: Result, run: RunRecord) -> Outcome:
    """Check a result and turn it into rows; raise ``InvalidResultError`` where it is malformed."""
    check_result(claim.trial_key, result)
    steps = np.column_stack([getattr(result, name) for name in STEP_VALUES]).astype(np.float64)
    steps[~np.isfinite(steps)] = np.nan
    summary = {
        "status": "done" if result.diverged_at is None else "diverged",
        "n_steps": plain(result.n_steps),
        "final_loss": finite(result.final_loss),
        "best_loss": finite(result.best_loss),
        "diverged_at": plain(result.diverged_at),
        "error_id": None,
        "cause": None,
        **_run_row(run),
    }
    return Outcome(
        claim, summary, steps, _trajectory_row(claim, result), _assessment_rows(claim, result)
    )


def _trajectory_row(claim: Claim, result: Result) -> dict[str, Any]:
    row: dict[str, Any] = {"trial_id": claim.trial_id, "dtype": DTYPE}
    for name in ("states", "inputs", "parameters"):
        row[f"{name}_shape"], row[name] = pack(getattr(result, name))
    return row


def _assessment_rows(claim: Claim, result: Result) -> list[dict[str, Any]]:
    return [
        {
            "trial_id": claim.trial_id,
            "t": int(row.t),
            "measure": row.measure,
            "value": finite(row.value),
        }
        for row in result.assessments
    ]


def _run_row(run: RunRecord) -> dict[str, Any]:
    return {
        "node": run.node,
        "pid": int(run.pid),
        "wall_seconds": finite(run.wall_seconds),
        "cpu_seconds": finite(run.cpu_seconds),
        "peak_memory_bytes": int(run.peak_memory_bytes),
        "started": utc_text(run.started),
        "ended": utc_text(run.ended),
    }


def write(connection: Connection, backend: Backend, outcome: Outcome) -> bool:
    """Write a finished trial; False, and nothing written, where the claim is no longer held."""
    horizon = _pass_fence(connection, outcome.claim, outcome.summary)
    if horizon is None:
        return False
    check_horizon(outcome.claim.trial_key, len(outcome.steps), horizon)
    backend.insert_steps(connection, outcome.claim.trial_id, outcome.steps)
    connection.execute(_INSERT_TRAJECTORY, outcome.trajectory)
    if outcome.assessments:
        connection.execute(_INSERT_ASSESSMENT, outcome.assessments)
    _end_attempt(connection, outcome.claim, outcome.summary)
    return True


def write_failure(connection: Connection, claim: Claim, failure: Failure, run: RunRecord) -> bool:
    """Write a failed trial; False, and nothing written, where the claim is no longer held."""
    values = {
        "status": "failed",
        "n_steps": None,
        "final_loss": None,
        "best_loss": None,
        "diverged_at": None,
        "cause": failure.cause,
        **_run_row(run),
    }
    if _pass_fence(connection, claim, values) is None:
        return False
    values["error_id"] = _error_id(connection, failure)
    connection.execute(_SET_ERROR, {"fence_trial": claim.trial_id, **values})
    _end_attempt(connection, claim, values)
    return True


def is_written(connection: Connection, claim: Claim) -> bool:
    """Tell whether this very attempt has an outcome, whoever still knows of it."""
    statement = select(attempt.c.outcome).where(
        attempt.c.trial_id == claim.trial_id, attempt.c.attempt == claim.attempt
    )
    return connection.execute(statement).scalar_one_or_none() in ("done", "diverged", "failed")


def _pass_fence(connection: Connection, claim: Claim, values: Mapping[str, Any]) -> int | None:
    """Return the horizon of the trial, or None where the claim is no longer held."""
    fence = {"fence_owner": claim.launch, **_attempt_key(claim)}
    return connection.execute(_FENCED, {**fence, **values}).scalar_one_or_none()


def _end_attempt(connection: Connection, claim: Claim, values: Mapping[str, Any]) -> None:
    connection.execute(_END_ATTEMPT, {**_attempt_key(claim), **values})


def _attempt_key(claim: Claim) -> dict[str, int]:
    return {"fence_trial": claim.trial_id, "fence_attempt": claim.attempt}


def _error_id(connection: Connection, failure: Failure) -> int:
    row = {
        "type": storable(failure.type),
        "message": storable(without_password(failure.message)),
        "traceback": storable(without_password(failure.traceback)),
    }
    row["hash"] = hashlib.sha256("\0".join(row.values()).encode()).hexdigest()
    connection.execute(_INSERT_ERROR, row)
    return int(connection.execute(_ERROR_ID, {"hash": row["hash"]}).scalar_one())
