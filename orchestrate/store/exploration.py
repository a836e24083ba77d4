"""Explorations, which grow: one trial is written again and again, each time as a whole.

An exploration is done at every save: what is stored is complete up to its ``n_steps``, which may be
fewer than the horizon, and a later save adds to it. The first save of a session compares all states
and inputs with the stored ones and replaces the steps; the next ones append to them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Connection, delete, insert, select, update

from orchestrate.records import RunRecord
from orchestrate.store import packed_curves
from orchestrate.store.backends.base import Backend
from orchestrate.store.errors import StoreError
from orchestrate.store.launches import GridRows, begin_attempts, register, renew
from orchestrate.store.records import Array, Claim, Registrable, Result, unpack
from orchestrate.store.results import PreparedRows, end_attempt, prepare
from orchestrate.store.schema import OUTCOME_COLUMNS, assessment, config, step, trajectory, trial

ROUNDING = 1e-6
"""Difference of two states, relative to their size or 1, that counts as none."""

Path = tuple[Array, Array]
"""States (T + 1, d) and inputs (T, m)."""


def steps_ahead(one: Path, other: Path) -> int | None:
    """Return how many steps the first path has more than the second; None for different paths.

    The last state of the shorter one is not compared: after a gap an exploration goes on from
    another state. States may be estimates, which another processor computes with other rounding.
    """
    n = min(len(one[1]), len(other[1]))
    states = (one[0][:n], other[0][:n])
    same = np.array_equal(one[1][:n], other[1][:n], equal_nan=True) and (
        states[0].shape == states[1].shape
        and np.allclose(*states, rtol=ROUNDING, atol=ROUNDING, equal_nan=True)
    )
    return len(one[1]) - len(other[1]) if same else None


def unpacked(row: Mapping[str, Any]) -> Path:
    """Return the path in a row of the table ``trajectory``."""
    states = unpack(row["dtype"], row["states_shape"], row["states"])
    return states, unpack(row["dtype"], row["inputs_shape"], row["inputs"])


@dataclass(frozen=True)
class Saved:
    """Attempt at a trial under which a session has saved, and the number of saved steps."""

    claim: Claim
    n_steps: int


def save(
    connection: Connection,
    backend: Backend,
    launch_id: int,
    spec: Registrable,
    result: Result,
    run: RunRecord,
    last: Saved | None,
) -> Saved | None:
    """Write an exploration and return what the next save appends to.

    Where the database holds more steps of it, nothing is written and None is returned. Raises
    ``StoreError`` if the database holds another exploration of the same key.
    """
    backend.exclusive(connection)  # before any row is locked, as everywhere
    renew(connection, backend, launch_id)
    if last is None or last.n_steps > len(result.loss) or not _is_mine(connection, last):
        last = _take(connection, backend, launch_id, spec, result)
    if last is None:
        return None
    rows = prepare(last.claim, result, run)
    _write_steps(connection, backend, rows, last.n_steps)
    _replace_arrays(connection, rows)
    outcome = {name: rows.summary[name] for name in ("status", *OUTCOME_COLUMNS)}
    connection.execute(
        update(trial)
        .where(trial.c.trial_id == last.claim.trial_id)
        .values(**outcome, attempt=last.claim.attempt, launch_id=launch_id, owner=None)
    )
    end_attempt(connection, last.claim, rows.summary)
    return Saved(last.claim, len(result.loss))


def is_longer(connection: Connection, backend: Backend, spec: Registrable, result: Result) -> bool:
    """Tell whether the database holds more steps of an exploration.

    Raises ``StoreError`` if it holds another exploration of the same key.
    """
    statement = (
        select(trajectory)
        .join(trial, trial.c.trial_id == trajectory.c.trial_id)
        .where(trial.c.trial_key == spec.trial_key)
    )
    row = connection.execute(statement).mappings().one_or_none()
    if row is None:
        return False
    stored = unpacked(dict(row))
    ahead = steps_ahead(stored, (result.states, result.inputs))
    if ahead is None:
        raise StoreError(
            f"The results database {backend.safe_url} holds another exploration of the same "
            f"plant, policy, model, learner, steps and seed ({len(stored[1]):,} steps): explore "
            f"with another seed, or save to another database."
        )
    return ahead > 0


def _is_mine(connection: Connection, last: Saved) -> bool:
    """Tell whether no other session has written the trial since; lock it."""
    statement = select(trial.c.trial_key, trial.c.attempt, trial.c.launch_id)
    one = statement.where(trial.c.trial_id == last.claim.trial_id).with_for_update()
    row = connection.execute(one).one_or_none()
    claim = last.claim
    return row is not None and tuple(row) == (claim.trial_key, claim.attempt, claim.launch)


def _take(
    connection: Connection, backend: Backend, launch_id: int, spec: Registrable, result: Result
) -> Saved | None:
    """Begin an attempt at the trial, without steps; return None if more of it is stored."""
    register(connection, backend, launch_id, GridRows([spec]))
    statement = select(trial.c.trial_id, trial.c.attempt).where(trial.c.trial_key == spec.trial_key)
    trial_id, attempts = connection.execute(statement.with_for_update()).one()
    if is_longer(connection, backend, spec, result):
        return None
    claim = Claim(spec.trial_key, trial_id, attempts + 1, launch_id)
    begin_attempts(connection, [claim])
    connection.execute(delete(step).where(step.c.trial_id == trial_id))
    return Saved(claim, 0)


def _write_steps(
    connection: Connection, backend: Backend, rows: PreparedRows, n_stored: int
) -> None:
    """Append the new steps; those of a diverged exploration go on to the horizon, as NaN."""
    trial_id, steps = rows.claim.trial_id, rows.steps
    if rows.summary["diverged_at"] is not None:
        statement = select(config.c.horizon).join(trial, trial.c.config_id == config.c.config_id)
        horizon = connection.execute(statement.where(trial.c.trial_id == trial_id)).scalar_one()
        missing = np.full((horizon - len(steps), steps.shape[1]), np.nan)
        steps, n_stored = np.concatenate([steps, missing]), 0
        connection.execute(delete(step).where(step.c.trial_id == trial_id))
    backend.insert_steps(connection, trial_id, steps[n_stored:], n_stored)
    packed_curves.write(connection, [(trial_id, rows.claim.attempt, steps)])


def _replace_arrays(connection: Connection, rows: PreparedRows) -> None:
    """Replace the trajectory, and the assessments where there are new ones."""
    trial_id = rows.claim.trial_id
    connection.execute(delete(trajectory).where(trajectory.c.trial_id == trial_id))
    connection.execute(insert(trajectory), rows.trajectory)
    if rows.assessments:
        connection.execute(delete(assessment).where(assessment.c.trial_id == trial_id))
        connection.execute(insert(assessment), rows.assessments)
