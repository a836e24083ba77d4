"""Claims of trials: from pending to a launch, and back to pending."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import ColumnElement, Connection, Select, delete, insert, select, update

from orchestrate.store.backends.base import Backend
from orchestrate.store.records import Claim
from orchestrate.store.schema import (
    OUTCOME_COLUMNS,
    PREQUENTIAL,
    RETRIED,
    alike,
    assessment,
    attempt,
    config,
    curve,
    step,
    trajectory,
    trial,
)
from orchestrate.store.serialization import not_before, now


def claim(
    connection: Connection,
    backend: Backend,
    launch_id: int,
    trial_keys: Sequence[str],
    only_alike: bool = False,
) -> list[Claim]:
    """Claim those of the trials that are pending, in the given order.

    ``only_alike`` leaves out what code with another fingerprint has registered.
    """
    free = (
        select(trial.c.trial_id)
        .where(trial.c.trial_key.in_(backend.members(trial_keys)), trial.c.status == "pending")
        .with_for_update(skip_locked=True)
    )
    if only_alike:
        free = free.where(trial.c.registered_by.in_(alike(launch_id)))
    statement = (
        update(trial)
        .where(trial.c.trial_id.in_(free))
        .values(status="running", owner=launch_id, attempt=trial.c.attempt + 1)
        .returning(trial.c.trial_key, trial.c.trial_id, trial.c.attempt)
    )
    rows = connection.execute(statement).all()
    claims = {key: Claim(key, trial_id, number, launch_id) for key, trial_id, number in rows}
    begin_attempts(connection, list(claims.values()))
    return [claims[key] for key in dict.fromkeys(trial_keys) if key in claims]


def begin_attempts(connection: Connection, claims: Sequence[Claim]) -> None:
    """Insert the attempts of new claims."""
    moment = now()
    rows = [
        {
            "trial_id": one.trial_id,
            "attempt": one.attempt,
            "launch_id": one.launch,
            "claimed": moment,
        }
        for one in claims
    ]
    if rows:
        connection.execute(insert(attempt), rows)


def free_claims(
    connection: Connection,
    launch_ids: Sequence[int],
    outcome: str,
    only: Select[Any] | None = None,
    cause: str | None = None,
    skip_locked: bool = False,
) -> int:
    """Put running trials of the launches back to pending, those with a key in ``only`` if given.

    ``skip_locked`` leaves out rows that another transaction has locked.
    """
    if not launch_ids:
        return 0
    held = trial.c.owner.in_(launch_ids) & (trial.c.status == "running")
    open_attempt = attempt.c.launch_id.in_(launch_ids) & attempt.c.outcome.is_(None)
    if only is not None:
        chosen = select(trial.c.trial_id).where(trial.c.trial_key.in_(only))
        held = held & trial.c.trial_id.in_(chosen)
        open_attempt = open_attempt & attempt.c.trial_id.in_(chosen)
    still_held = select(trial.c.trial_id).where(held)
    if skip_locked:
        held = held & trial.c.trial_id.in_(still_held.with_for_update(skip_locked=True))
    # Trials first, as a commit does, so that the two cannot wait for each other.
    freed = connection.execute(update(trial).where(held).values(status="pending", owner=None))
    over = open_attempt & attempt.c.trial_id.not_in(still_held)
    end = {"outcome": outcome, "cause": cause, "ended": not_before(attempt.c.claimed, now())}
    connection.execute(update(attempt).where(over).values(end))
    return freed.rowcount


def retry(
    connection: Connection, backend: Backend, status: str, trial_keys: Sequence[str] | None
) -> int:
    """Put finished but unsuccessful trials back to pending, without what they had written.

    Explorations stay, as no launch can run them again.
    """
    if status not in RETRIED:
        raise ValueError(
            f"Trials cannot be retried by the status '{status}': give {', '.join(RETRIED)}."
        )
    backend.exclusive(connection)
    explored = select(config.c.config_id).where(config.c.config_json.like(PREQUENTIAL))
    which: ColumnElement[bool] = trial.c.status.in_(RETRIED[status])
    which = which & trial.c.config_id.not_in(explored)
    if trial_keys is not None:
        which = which & trial.c.trial_key.in_(backend.members(trial_keys))
    pending = {"status": "pending", **dict.fromkeys((*OUTCOME_COLUMNS, "launch_id", "error_id"))}
    reset = update(trial).where(which).values(pending).returning(trial.c.trial_key)
    keys = list(connection.execute(reset).scalars())
    # By the keys: a launch may write another outcome of the same status meanwhile.
    chosen = select(trial.c.trial_id).where(trial.c.trial_key.in_(backend.members(keys)))
    for table in (step, trajectory, assessment, curve):
        connection.execute(delete(table).where(table.c.trial_id.in_(chosen)))
    return len(keys)
