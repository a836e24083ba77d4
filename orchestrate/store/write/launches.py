"""Rows of launches: insertion, lease renewal, end, and recovery of the trials of dead launches."""

from __future__ import annotations

import json

from sqlalchemy import Connection, insert, or_, select, update

from orchestrate.store.backends.base import Backend, LaunchLife
from orchestrate.store.errors import LaunchAliveError
from orchestrate.store.records import LaunchRecord
from orchestrate.store.schema import LAUNCH_STATES, launch, trial
from orchestrate.store.serialization import not_before, now
from orchestrate.store.write.claims import free_claims


def begin(connection: Connection, backend: Backend, record: LaunchRecord, token: str) -> int:
    """Insert a running launch and return its number.

    The launch holds its lock or lease before the transaction ends, so that no other process finds
    it without one and takes it for dead.
    """
    statement = insert(launch).values(
        token=token,
        state="running",
        started=now(),
        host=record.host,
        pid=int(record.pid),
        argv=json.dumps(list(record.argv)),
        overrides=json.dumps(list(record.overrides)),
        git_commit=record.git_commit,
        git_dirty=None if record.git_dirty is None else int(record.git_dirty),
        git_diff_hash=record.git_diff_hash,
        versions=json.dumps(dict(record.versions), sort_keys=True),
        fingerprint=record.fingerprint and json.dumps(dict(record.fingerprint), sort_keys=True),
    )
    launch_id = int(connection.execute(statement.returning(launch.c.launch_id)).scalar_one())
    backend.hold(connection, launch_id, token)
    return launch_id


def end(connection: Connection, launch_id: int, state: str, exit_code: int | None) -> str:
    """Write the final state, release the remaining claims and return the token of the launch."""
    if state not in LAUNCH_STATES[1:]:
        raise ValueError(f"A launch cannot end as '{state}': give {', '.join(LAUNCH_STATES[1:])}.")
    statement = (
        update(launch)
        .where(launch.c.launch_id == launch_id)
        .values(
            state=state,
            ended=not_before(launch.c.started, now()),
            lease_until=None,
            exit_code=None if exit_code is None else int(exit_code),
        )
        .returning(launch.c.token)
    )
    token = connection.execute(statement).scalar_one_or_none()
    if token is None:
        raise ValueError(f"There is no launch {launch_id}: end one that begin_launch returned.")
    free_claims(connection, [launch_id], "released")
    return str(token)


def renew(connection: Connection, backend: Backend, launch_id: int) -> None:
    """Renew the lease of the launch; one that was marked as lost is running again."""
    connection.execute(
        update(launch)
        .where(launch.c.launch_id == launch_id, launch.c.state == "lost")
        .values(state="running", ended=None, exit_code=None)
    )
    backend.renew(connection, launch_id)


def recover(connection: Connection, backend: Backend) -> tuple[int, list[str]]:
    """Put trials that dead launches claimed back to pending, and mark these launches as lost.

    Rows that another transaction has locked are skipped and left for the next recovery: that
    transaction ends soon, or :meth:`Backend.evict` ends it.

    Returns
    -------
    int
        Number of trials put back to pending.
    list of str
        Tokens of the dead launches.
    """
    backend.exclusive(connection)
    dead = backend.dead(connection, maybe_alive(connection, skip_locked=True))
    ids = [one.launch_id for one in dead]
    freed = free_claims(connection, ids, "lost", skip_locked=True)
    connection.execute(
        update(launch)
        .where(launch.c.launch_id.in_(ids), launch.c.state == "running")
        .values(state="lost", ended=not_before(launch.c.started, now()))
    )
    return freed, [one.token for one in dead]


def maybe_alive(connection: Connection, skip_locked: bool = False) -> list[LaunchLife]:
    """Return the launches whose state is running or that still own a trial.

    The statement uses only columns that every schema version has, because the upgrade of an older
    database calls it too. ``skip_locked`` leaves out launches whose lease another transaction is
    renewing.
    """
    owners = select(trial.c.owner).where(trial.c.owner.is_not(None))
    statement = (
        select(launch.c.launch_id, launch.c.token, launch.c.lease_until)
        .where(or_(launch.c.state == "running", launch.c.launch_id.in_(owners)))
        # FOR NO KEY UPDATE: another transaction that renews the lease waits for this one. A commit
        # of a result only checks that the launch exists (FOR KEY SHARE), does not wait, and so
        # cannot deadlock with this one.
        .with_for_update(key_share=True, skip_locked=skip_locked)
    )
    return [LaunchLife(*row) for row in connection.execute(statement)]


def living(connection: Connection, backend: Backend) -> list[LaunchLife]:
    """Return the launches whose process lives."""
    candidates = maybe_alive(connection)
    dead = {one.launch_id for one in backend.dead(connection, candidates)}
    return [one for one in candidates if one.launch_id not in dead]


def refuse_living(connection: Connection, backend: Backend) -> None:
    """Raise ``LaunchAliveError`` if a launch is running."""
    alive = [one.launch_id for one in living(connection, backend)]
    if not alive:
        return
    columns = select(launch.c.launch_id, launch.c.pid, launch.c.host)
    row = connection.execute(columns.where(launch.c.launch_id == min(alive))).one()
    raise LaunchAliveError(
        f"Launch {row.launch_id} (process {row.pid} on {row.host}) is running in "
        f"{backend.safe_url}: wait for its end, or stop it, and run the same command again."
    )
