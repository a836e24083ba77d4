"""Deletion of trials with an outcome, and of what only they refer to."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, delete, or_, select, union

from orchestrate.store.backends.base import Backend
from orchestrate.store.schema import (
    ENDED,
    assessment,
    attempt,
    config,
    curve,
    error,
    step,
    trajectory,
    trial,
)
from orchestrate.store.write.launches import living

PAGE = 50
"""Trials in one transaction, so that a launch waits for less than a second."""


def prune(connection: Connection, backend: Backend, trial_keys: Sequence[str]) -> int:
    """Delete those of the trials that have an outcome and none of a living launch; count them."""
    alive = [one.launch_id for one in living(connection, backend)]
    chosen = (
        select(trial.c.trial_id)
        .where(trial.c.trial_key.in_(backend.members(trial_keys)), trial.c.status.in_(ENDED))
        .where(or_(trial.c.launch_id.is_(None), trial.c.launch_id.not_in(alive)))
        .order_by(trial.c.trial_id)
        .with_for_update()
    )
    found = list(connection.execute(chosen).scalars())
    for table in (step, trajectory, assessment, curve, attempt, trial):
        connection.execute(delete(table).where(table.c.trial_id.in_(found)))
    return len(found)


def prune_unused(connection: Connection, backend: Backend) -> None:
    """Delete configurations without a trial, and tracebacks without a trial or an attempt."""
    backend.exclusive(connection)
    used = select(trial.c.config_id).where(trial.c.config_id == config.c.config_id)
    connection.execute(delete(config).where(~used.exists()))
    named = (select(table.c.error_id) for table in (trial, attempt))
    kept = union(*(one.where(one.selected_columns.error_id.is_not(None)) for one in named))
    unused = error.c.error_id.not_in(kept)
    # Locked first: a trial that fails now may refer to one of them before it can be deleted.
    locked = select(error.c.error_id).where(unused).with_for_update(skip_locked=True)
    found = list(connection.execute(locked).scalars())
    for start in range(0, len(found), PAGE):
        page = found[start : start + PAGE]
        connection.execute(delete(error).where(error.c.error_id.in_(page), unused))
