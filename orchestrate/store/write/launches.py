"""Launches: beginning, heartbeat, end, and recovery of dead ones."""

from __future__ import annotations

import json

from sqlalchemy import Connection, insert, or_, select, update

from orchestrate.store.backends.base import Backend, LaunchLife
from orchestrate.store.records import LaunchRecord
from orchestrate.store.schema import LAUNCH_STATES, launch, trial
from orchestrate.store.serialization import now
from orchestrate.store.write.claims import free_claims


def begin(connection: Connection, backend: Backend, record: LaunchRecord) -> int:
    """Insert the launch, alive from the first moment that others can see it."""
    token = backend.token()
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
    )
    launch_id = int(connection.execute(statement.returning(launch.c.launch_id)).scalar_one())
    backend.hold(connection, launch_id, token)
    return launch_id


def end(connection: Connection, launch_id: int, state: str, exit_code: int | None) -> str:
    """Write the last state, release the remaining claims and return the token of the launch."""
    if state not in LAUNCH_STATES[1:]:
        raise ValueError(f"A launch cannot end as '{state}': give {', '.join(LAUNCH_STATES[1:])}.")
    statement = (
        update(launch)
        .where(launch.c.launch_id == launch_id)
        .values(
            state=state,
            ended=now(),
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
    """Extend the life of the launch, also after it was marked as lost."""
    connection.execute(
        update(launch)
        .where(launch.c.launch_id == launch_id, launch.c.state == "lost")
        .values(state="running", ended=None, exit_code=None)
    )
    backend.renew(connection, launch_id)


def recover(connection: Connection, backend: Backend) -> tuple[int, list[str]]:
    """Free the claims of dead launches; return how many, and the tokens of the dead.

    What is locked just now is left for the next recovery: its transaction ends soon, or is evicted.
    """
    backend.exclusive(connection)
    dead = backend.dead(connection, maybe_alive(connection, skip_locked=True))
    ids = [one.launch_id for one in dead]
    freed = free_claims(connection, ids, "lost", skip_locked=True)
    connection.execute(
        update(launch)
        .where(launch.c.launch_id.in_(ids), launch.c.state == "running")
        .values(state="lost", ended=now())
    )
    return freed, [one.token for one in dead]


def maybe_alive(connection: Connection, skip_locked: bool = False) -> list[LaunchLife]:
    """Return the launches that run or still own a trial; in every schema alike.

    ``skip_locked`` leaves out those of which a transaction is just renewing the lease.
    """
    owners = select(trial.c.owner).where(trial.c.owner.is_not(None))
    statement = (
        select(launch.c.launch_id, launch.c.token, launch.c.lease_until)
        .where(or_(launch.c.state == "running", launch.c.launch_id.in_(owners)))
        # A renewal of the lease waits for the verdict; a commit, which only needs the launch to
        # exist, does not, and so cannot lock up with this.
        .with_for_update(key_share=True, skip_locked=skip_locked)
    )
    return [LaunchLife(*row) for row in connection.execute(statement)]
