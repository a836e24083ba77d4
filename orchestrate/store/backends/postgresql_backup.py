"""Backup of a PostgreSQL schema as a second schema of the same database.

The backup needs no other program or disk. It is made in the transaction of the change, so that it
holds exactly the previous state, and is rolled back if the change fails.
"""

from __future__ import annotations

from itertools import chain, count

from sqlalchemy import Connection, text

from orchestrate.store.errors import StoreError
from orchestrate.store.schema import LOCK_TABLE

_MAY_CREATE = text("SELECT has_database_privilege(current_database(), 'CREATE')")
_HERE = text("SELECT current_schema(), current_setting('search_path')")
_SEARCH = text("SELECT set_config('search_path', :path, true)")
_SCHEMAS = text("SELECT nspname FROM pg_namespace")

# Definitions do not name the schema while it is the first one of the search path.
_TABLES = text(
    "SELECT quote_ident(relname) FROM pg_class "
    f"WHERE relkind = 'r' AND relnamespace = to_regnamespace(:here) AND relname <> '{LOCK_TABLE}' "
    "ORDER BY oid"
)
_KEYS = text(
    "SELECT conrelid::regclass::text, quote_ident(conname), pg_get_constraintdef(oid) "
    "FROM pg_constraint WHERE contype IN ('p', 'u', 'f') "
    "AND connamespace = to_regnamespace(:here) ORDER BY contype = 'f', oid"
)
_INDEXES = text(
    "SELECT pg_get_indexdef(indexrelid) FROM pg_index "
    "JOIN pg_class ON pg_class.oid = indexrelid AND relnamespace = to_regnamespace(:here) "
    "WHERE NOT EXISTS (SELECT FROM pg_constraint WHERE conindid = indexrelid) ORDER BY indexrelid"
)
_SEQUENCES = text(
    "SELECT s.oid::regclass::text, c.oid::regclass::text, quote_ident(a.attname) "
    "FROM pg_depend d JOIN pg_class s ON s.oid = d.objid AND s.relkind = 'S' "
    "JOIN pg_class c ON c.oid = d.refobjid "
    "JOIN pg_attribute a ON a.attrelid = c.oid AND a.attnum = d.refobjsubid "
    "WHERE d.deptype = 'a' AND s.relnamespace = to_regnamespace(:here) ORDER BY s.oid"
)
_VIEWS = text(
    "SELECT quote_ident(relname), pg_get_viewdef(oid) FROM pg_class "
    "WHERE relkind = 'v' AND relnamespace = to_regnamespace(:here) ORDER BY oid"
)


def copy_schema(connection: Connection, version: int, safe_url: str) -> str:
    """Copy all tables, sequences, keys, indexes and views; return the name of the new schema.

    To restore, drop the schema and rename the copy. Raises ``StoreError`` if the user may not
    create a schema.
    """
    if not connection.execute(_MAY_CREATE).scalar_one():
        raise StoreError(
            f"A backup of {safe_url} needs the right to create a schema, which its user does not "
            "have: ask for it, or dump the database yourself, with pg_dump, and give --no-backup."
        )
    here, path = connection.execute(_HERE).one()
    there = _free_name(connection, f"{here}_v{version}_backup")
    old, new = (connection.dialect.identifier_preparer.quote(name) for name in (here, there))
    connection.execute(_SEARCH, {"path": old})
    statements = list(_statements(connection, old, new))
    connection.execute(_SEARCH, {"path": new})
    for statement in statements:
        connection.exec_driver_sql(statement, execution_options={"no_parameters": True})
    connection.execute(_SEARCH, {"path": path})
    return there


def _statements(connection: Connection, old: str, new: str) -> list[str]:
    """Return the statements that make the copy while the new schema is first in the search path."""
    tables, keys, indexes, sequences, views = (
        connection.execute(query, {"here": old}).all()
        for query in (_TABLES, _KEYS, _INDEXES, _SEQUENCES, _VIEWS)
    )
    made = [f"CREATE SCHEMA {new}"]
    for (table,) in tables:
        made.append(f"CREATE TABLE {table} (LIKE {old}.{table} INCLUDING ALL EXCLUDING INDEXES)")
        made.append(f"INSERT INTO {table} SELECT * FROM {old}.{table}")
    for sequence, table, column in sequences:
        made.append(f"CREATE SEQUENCE {sequence} OWNED BY {table}.{column}")
        made.append(f"SELECT setval('{sequence}', last_value, is_called) FROM {old}.{sequence}")
        default = f"SET DEFAULT nextval('{sequence}')"
        made.append(f"ALTER TABLE {table} ALTER COLUMN {column} {default}")
    made += [f"ALTER TABLE {table} ADD CONSTRAINT {name} {what}" for table, name, what in keys]
    made += [index.replace(f" ON {old}.", f" ON {new}.", 1) for (index,) in indexes]
    made += [f"CREATE VIEW {name} AS {query}" for name, query in views]
    return made


def _free_name(connection: Connection, base: str) -> str:
    taken = set(connection.execute(_SCHEMAS).scalars())
    names = chain([base], (f"{base}_{i}" for i in count(2)))
    return next(name for name in names if name not in taken)
