"""Upgrade of an older database to the newest schema, atomic and with a backup.

The check for running launches, the backup, the migration and the labels of configurations are one
exclusive transaction. A migration script uses no code of the program that may change; what the
current program computes, the labels, is written after the scripts.
"""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, select

from orchestrate.store import database_url, migrations, schema_version
from orchestrate.store.backends import sqlite
from orchestrate.store.backends.base import Backend
from orchestrate.store.backends.open import make_backend
from orchestrate.store.errors import LaunchAliveError
from orchestrate.store.schema import SCHEMA_VERSION, launch
from orchestrate.store.write import labels, launches


@dataclass(frozen=True)
class Upgrade:
    """Result of an upgrade.

    Attributes
    ----------
    before, after
        Version of the schema; ``before`` is None if the database was empty.
    backup
        Name of the backup, a file beside a SQLite database or a schema beside the PostgreSQL
        one; None without a backup.
    """

    safe_url: str
    before: int | None
    after: int
    backup: str | None

    @property
    def changed(self) -> bool:
        return self.before != self.after


def upgrade(url: str, backup: bool = True) -> Upgrade:
    """Migrate a results database to the newest schema, if it has an older one.

    Raises
    ------
    NoDatabaseError
        If there is no file.
    SchemaVersionError
        If the database is not a results database, or one of a newer program.
    LaunchAliveError
        If a launch is running in it.
    StoreUnavailableError
        If the database fails; it is then unchanged.
    """
    parsed = database_url.parse(url)
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
            if schema_version.is_empty(connection):
                schema_version.create(connection)
                return Upgrade(backend.safe_url, None, SCHEMA_VERSION, None)
            before = schema_version.version_of(connection, backend.safe_url)
            schema_version.check_not_newer(before, backend.safe_url)
            if before < SCHEMA_VERSION:
                _refuse_living(connection, backend)
                name = backend.back_up(connection, before) if backup else None
                migrations.migrate(connection, before)
                labels.write_missing(connection)
    except BaseException:
        if name is not None:
            backend.discard_backup(name)
        raise
    return Upgrade(backend.safe_url, before, SCHEMA_VERSION, name)


def _refuse_living(connection: Connection, backend: Backend) -> None:
    """Raise ``LaunchAliveError`` if a launch is running."""
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
