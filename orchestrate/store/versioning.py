"""Creation of a new database, and refusal of one that another program version wrote."""

from __future__ import annotations

from sqlalchemy import Connection, insert, inspect, select, text

from orchestrate.store.errors import SchemaVersionError
from orchestrate.store.schema import SCHEMA_VERSION, metadata, schema_version
from orchestrate.store.views import VIEWS


def create_or_check(connection: Connection, safe_url: str) -> None:
    """Create everything in an empty database; else raise ``SchemaVersionError`` if it differs."""
    if inspect(connection).get_table_names():
        check(connection, safe_url)
    else:
        _create(connection)


def check(connection: Connection, safe_url: str) -> int:
    """Return the version of the schema; raise ``SchemaVersionError`` unless it is the program's."""
    if not inspect(connection).has_table(schema_version.name):
        raise SchemaVersionError(
            f"{safe_url} is not a results database of this program (it has no table "
            f"'{schema_version.name}'): give the URL of another one, or of a new one."
        )
    version = int(connection.execute(select(schema_version.c.version)).scalar_one())
    if version == SCHEMA_VERSION:
        return version
    age, advice = (
        ("an older", "open it with the program that wrote it, or start a new one")
        if version < SCHEMA_VERSION
        else ("a newer", "update the program")
    )
    raise SchemaVersionError(
        f"The results database {safe_url} was written by {age} program (its schema is version "
        f"{version}, this program reads version {SCHEMA_VERSION}): {advice}."
    )


def _create(connection: Connection) -> None:
    metadata.create_all(connection, checkfirst=False)
    for name, query in VIEWS.items():
        connection.execute(text(f"CREATE VIEW {name} AS {query}"))
    connection.execute(insert(schema_version).values(version=SCHEMA_VERSION))
