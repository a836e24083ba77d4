"""Creation of a new database, and version check of an existing one."""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import Connection, inspect, text

from orchestrate.store import migrations
from orchestrate.store.errors import SchemaVersionError
from orchestrate.store.schema import (
    LOCK_TABLE,
    SCHEMA_VERSION,
    alembic_version,
    metadata,
)

OLDEST = 5
"""Oldest schema that is upgraded."""

CHECK_SECONDS = 10.0
"""Time that the check of a database may take, which a stranger may have made."""

_PROGRESS_STEPS = 10_000  # instructions of SQLite's virtual machine, well below a millisecond

# Of tables alone: a view may never end. Nor does a generated column hold what is in the file.
_COLUMNS = {
    "sqlite": "SELECT l.name, x.name, CASE x.hidden WHEN 0 THEN x.type END "
    "FROM pragma_table_list AS l, pragma_table_xinfo(l.name) AS x "
    "WHERE l.schema = 'main' AND l.type = 'table' AND l.strict = 1",
    "postgresql": "SELECT c.relname, a.attname, "
    "CASE a.attgenerated WHEN '' THEN upper(format_type(a.atttypid, NULL)) END "
    "FROM pg_class AS c JOIN pg_attribute AS a ON a.attrelid = c.oid WHERE c.relkind = 'r' "
    "AND c.relnamespace = to_regnamespace(current_schema()) AND a.attnum > 0 AND a.atttypid > 0",
}


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
    migrations.create_views(connection)
    migrations.stamp(connection, SCHEMA_VERSION)


def check(connection: Connection, safe_url: str) -> int:
    """Return the version of the schema; raise ``SchemaVersionError`` for another one.

    Raises it too if a table is a view, or has not the columns of this program.
    """
    with _limited(connection):
        version = _check_version(connection, safe_url)
        _check_tables(connection, safe_url)
    return version


@contextmanager
def _limited(connection: Connection) -> Iterator[None]:
    """End a statement of the block that takes too long."""
    if connection.dialect.name == "postgresql":
        connection.exec_driver_sql(f"SET LOCAL statement_timeout = {1000 * CHECK_SECONDS:.0f}")
        yield
        connection.exec_driver_sql("SET LOCAL statement_timeout = DEFAULT")
        return
    driver, end = connection.connection.driver_connection, time.monotonic() + CHECK_SECONDS
    driver.set_progress_handler(lambda: time.monotonic() > end, _PROGRESS_STEPS)  # type: ignore[union-attr]
    try:
        yield
    finally:
        driver.set_progress_handler(None, 0)  # type: ignore[union-attr]


def _check_tables(connection: Connection, safe_url: str) -> None:
    rows = connection.exec_driver_sql(_COLUMNS[connection.dialect.name])
    found = {(table, column): kind for table, column, kind in rows}
    generated = {table for (table, _), kind in found.items() if kind is None}
    tables = [one for one in metadata.sorted_tables if one is not alembic_version]
    for table in tables:
        kinds = {one.name: one.type.compile(connection.dialect) for one in table.columns}
        whole = all(found.get((table.name, name)) == kind for name, kind in kinds.items())
        if not whole or table.name in generated:
            raise SchemaVersionError(
                f"{safe_url} is not a results database of this program ({table.name} is no table, "
                "or has other columns): give the URL of another one, or of a new one."
            )


def _check_version(connection: Connection, safe_url: str) -> int:
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
    """Return the version of the schema; raise ``SchemaVersionError`` for others and old ones."""
    tables = inspect(connection).get_table_names()
    found = "1" if "schema_version" in tables else None  # before the program used Alembic
    if alembic_version.name in tables:
        found = connection.execute(text("SELECT max(version_num) FROM alembic_version")).scalar()
    if "trial" not in tables or not str(found).isdecimal():
        raise SchemaVersionError(
            f"{safe_url} is not a results database of this program (it has no table "
            f"'{alembic_version.name}' with the number of a schema): give the URL of another one, "
            "or of a new one."
        )
    version = int(str(found))
    if version < OLDEST:
        raise SchemaVersionError(
            f"The results database {safe_url} has schema {version}, but only schemas from {OLDEST} "
            "on are upgraded: export it with the release of this program that wrote it."
        )
    return version
