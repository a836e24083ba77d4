"""Upgrade of an older database to the newest schema, atomic and with a backup.

The check for running launches, the backup, the migration and the labels of configurations are one
exclusive transaction. The statements of a schema never change; what the current program computes,
the labels, is written after them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

from sqlalchemy import Connection, bindparam, select, text, update

from dopt.spec.config import REGISTRIES, section_class
from dopt.spec.label import config_label
from orchestrate.store import database_url, launches, packed_curves, schema
from orchestrate.store.backends import sqlite
from orchestrate.store.backends.base import Backend
from orchestrate.store.backends.open import make_backend
from orchestrate.store.schema import (
    SCHEMA_VERSION,
    alembic_version,
    config,
    create_views,
    curve,
    drop_views,
)

STATEMENTS = {
    6: (
        "ALTER TABLE launch ADD COLUMN fingerprint TEXT",
        "ALTER TABLE trial ADD COLUMN registered_by {whole}",
    ),
    7: ("DROP TABLE live_step",),
}
"""Statements that make each schema of the one before it.

``{whole}`` is a 64-bit integer and ``{real}`` a double, which the databases call by other names.
"""


@dataclass(frozen=True)
class Upgrade:
    """Result of an upgrade.

    Attributes
    ----------
    before, after
        Version of the schema; ``before`` is None if the database was empty.
    backup
        Path of the backup, a file beside a SQLite database or an archive of ``pg_dump`` in the
        current folder; None without a backup.
    packed
        Trials whose curve was packed.
    """

    safe_url: str
    before: int | None
    after: int
    backup: str | None
    packed: int = 0

    @property
    def changed(self) -> bool:
        return self.before != self.after


def upgrade(url: str, backup: bool = True) -> Upgrade:
    """Migrate a results database to the newest schema, and pack the curves that lack it.

    Raises
    ------
    NoDatabaseError
        If there is no file.
    SchemaVersionError
        If the database is not a results database, or its schema is newer or too old.
    LaunchAliveError
        If a launch is running in it.
    StoreError
        If ``pg_dump`` is missing or older than the server.
    StoreUnavailableError
        If the database fails; it is then unchanged.
    """
    parsed = database_url.parse(url)
    if parsed.get_backend_name() == "sqlite":
        sqlite.existing_path(parsed)
    backend = make_backend(parsed)
    try:
        done = _upgrade(backend, backup)
        return replace(done, packed=packed_curves.write_missing(backend))
    finally:
        backend.close()


def _upgrade(backend: Backend, backup: bool) -> Upgrade:
    name = None
    try:
        with backend.creation() as connection:
            if schema.is_empty(connection):
                schema.create(connection)
                return Upgrade(backend.safe_url, None, SCHEMA_VERSION, None)
            before = schema.version_of(connection, backend.safe_url)
            schema.check_not_newer(before, backend.safe_url)
            if before < SCHEMA_VERSION:
                launches.refuse_living(connection, backend)
                name = backend.back_up(connection, before) if backup else None
                migrate(connection, before)
                curve.create(connection, checkfirst=True)
                _write_labels(connection)
            else:
                create_views(connection)
    except BaseException:
        if name is not None:
            Path(name).unlink(missing_ok=True)
        raise
    return Upgrade(backend.safe_url, before, SCHEMA_VERSION, name)


def _write_labels(connection: Connection) -> None:
    """Write the labels as this program makes them, of configurations whose classes are known."""
    columns = select(config.c.config_id, config.c.config_json, config.c.label)
    stored = [(row[0], json.loads(row[1]), row[2]) for row in connection.execute(columns)]
    rows = [
        {"id": config_id, "text": made}
        for config_id, document, label in stored
        if all(section_class(document, key) for key in REGISTRIES if document.get(key))
        and (made := config_label(document)) != label
    ]
    if rows:
        statement = update(config).where(config.c.config_id == bindparam("id"))
        connection.execute(statement.values(label=bindparam("text")), rows)


def migrate(connection: Connection, version: int) -> None:
    """Bring a database of a version to the newest schema, in the transaction of the caller.

    The views are dropped and created again: not every database can change a table below a view.
    """
    drop_views(connection)
    sqlite_names = connection.dialect.name == "sqlite"
    kinds = {
        "whole": "INTEGER" if sqlite_names else "BIGINT",
        "real": "REAL" if sqlite_names else "DOUBLE PRECISION",
    }
    for number in range(version + 1, SCHEMA_VERSION + 1):
        for statement in STATEMENTS[number]:
            connection.execute(text(statement.format(**kinds)))
    connection.execute(update(alembic_version).values(version_num=str(SCHEMA_VERSION)))
    create_views(connection)
