"""An older database becomes one of the newest schema, whole or not at all, with a copy beside it.

Everything happens in one transaction that no other writer can enter: the look for living launches,
the copy, the change of the tables.
"""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, select

from orchestrate.store import address, launches, migrations, sqlite, versioning
from orchestrate.store.backend import Backend
from orchestrate.store.errors import LaunchAliveError
from orchestrate.store.opening import make_backend
from orchestrate.store.schema import SCHEMA_VERSION, launch


@dataclass(frozen=True)
class Upgrade:
    """What an upgrade did.

    Attributes
    ----------
    before, after
        Version of the schema; ``before`` is None where the database was empty and was created.
    backup
        Name of the copy, or None where none was made: a file beside a SQLite database, a schema
        beside that of a PostgreSQL database.
    """

    safe_url: str
    before: int | None
    after: int
    backup: str | None

    @property
    def changed(self) -> bool:
        return self.before != self.after


def upgrade(url: str, backup: bool = True) -> Upgrade:
    """Bring a results database to the newest schema; one that has it already is left alone.

    Raises
    ------
    NoDatabaseError
        If there is no file.
    SchemaVersionError
        If the database is not one of this program, or of a newer one.
    LaunchAliveError
        If a launch is running in it.
    StoreUnavailableError
        If the database fails; it is then as it was before.
    """
    parsed = address.parse(url)
    if parsed.get_backend_name() == "sqlite":
        sqlite.existing_path(parsed)
    backend = make_backend(parsed)
    try:
        return _upgrade(backend, backup)
    finally:
        backend.close()


def _upgrade(backend: Backend, backup: bool) -> Upgrade:
    name = None
    try:
        with backend.rebuilding() as connection:
            if versioning.is_empty(connection):
                versioning.create(connection)
                return Upgrade(backend.safe_url, None, SCHEMA_VERSION, None)
            before = versioning.version_of(connection, backend.safe_url)
            versioning.check_not_newer(before, backend.safe_url)
            if before < SCHEMA_VERSION:
                _refuse_living(connection, backend)
                name = backend.back_up(connection, before) if backup else None
                migrations.migrate(connection, before)
    except BaseException:
        if name is not None:
            backend.discard_backup(name)
        raise
    return Upgrade(backend.safe_url, before, SCHEMA_VERSION, name)


def _refuse_living(connection: Connection, backend: Backend) -> None:
    """Raise ``LaunchAliveError`` where a launch runs."""
    candidates = launches.maybe_alive(connection)
    dead = {one.launch_id for one in backend.dead(connection, candidates)}
    alive = [one.launch_id for one in candidates if one.launch_id not in dead]
    if not alive:
        return
    columns = select(launch.c.launch_id, launch.c.pid, launch.c.host)
    row = connection.execute(columns.where(launch.c.launch_id == min(alive))).one()
    raise LaunchAliveError(
        f"Launch {row.launch_id} (process {row.pid} on {row.host}) is running in "
        f"{backend.safe_url}: wait for its end, or stop it, and run the same command again."
    )
