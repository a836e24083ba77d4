"""Creation of a new database, and version check of an existing one."""

from __future__ import annotations

import shlex

from sqlalchemy import Connection, inspect, text

from orchestrate.store import migrations, packed_curves
from orchestrate.store.errors import SchemaVersionError
from orchestrate.store.schema import LOCK_TABLE, SCHEMA_VERSION, alembic_version, metadata

# Table of the version before the program used Alembic.
_FIRST_TABLE = "schema_version"


def create_or_check(connection: Connection, safe_url: str) -> None:
    """Create the tables of an empty database; raise ``SchemaVersionError`` for another version."""
    if is_empty(connection):
        create(connection)
    else:
        check(connection, safe_url)


def is_empty(connection: Connection) -> bool:
    return set(inspect(connection).get_table_names()) <= {LOCK_TABLE}


def create(connection: Connection) -> None:
    """Create the newest tables and views in an empty database."""
    metadata.create_all(connection, checkfirst=False)
    packed_curves.create(connection)
    migrations.create_views(connection)
    migrations.stamp(connection, SCHEMA_VERSION)


def check(connection: Connection, safe_url: str) -> int:
    """Return the version of the schema; raise ``SchemaVersionError`` for another one."""
    version = version_of(connection, safe_url)
    if version < SCHEMA_VERSION:
        command = f"python -m orchestrate upgrade --db {shlex.quote(safe_url)}"
        raise SchemaVersionError(
            f"The results database {safe_url} was written by an older program (its schema is "
            f"version {version}, this program reads version {SCHEMA_VERSION}): run '{command}', "
            "which makes a backup first."
        )
    check_not_newer(version, safe_url)
    return version


def check_not_newer(version: int, safe_url: str) -> None:
    if version > SCHEMA_VERSION:
        raise SchemaVersionError(
            f"The results database {safe_url} was written by a newer program (its schema is "
            f"version {version}, this program reads version {SCHEMA_VERSION}): update the program."
        )


def version_of(connection: Connection, safe_url: str) -> int:
    """Return the version of a released schema; raise ``SchemaVersionError`` for other tables."""
    tables = inspect(connection).get_table_names()
    found = None
    if alembic_version.name in tables:
        found = connection.execute(text("SELECT max(version_num) FROM alembic_version")).scalar()
    elif _FIRST_TABLE in tables:
        found = connection.execute(text("SELECT max(version) FROM schema_version")).scalar()
    if "trial" not in tables or not str(found).isdecimal():
        raise SchemaVersionError(
            f"{safe_url} is not a results database of this program (it has no table "
            f"'{alembic_version.name}' with the number of a schema): give the URL of another one, "
            "or of a new one."
        )
    return int(str(found))
