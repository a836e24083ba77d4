"""Place of a database, and the files beside it."""

from __future__ import annotations

import re
import subprocess
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Connection, create_engine, text
from sqlalchemy.engine import make_url


def backups(url: str) -> list[Path]:
    folder = file_of(url).parent if url.startswith("sqlite") else Path.cwd()
    return sorted(folder.glob("*backup*"))


def file_of(url: str) -> Path:
    return Path(str(make_url(url).database))


def schema_of(url: str) -> str:
    return url.rpartition("%3D")[2]


def execute(url: str, sql: str) -> list[tuple[object, ...]]:
    engine = create_engine(url)
    with engine.begin() as connection:
        done = connection.execute(text(sql))
        rows = [tuple(row) for row in done] if done.returns_rows else []
    engine.dispose()
    return rows


@contextmanager
def new_schema(request: pytest.FixtureRequest) -> Iterator[str]:
    """Yield the URL of a new schema on the server, which is dropped afterwards."""
    server, url = (request.getfixturevalue(name) for name in ("server", "server_url"))
    schema = f"test_{uuid.uuid4().hex}"
    with server.begin() as connection:
        connection.execute(text(f"CREATE SCHEMA {schema}"))
    yield f"{url}?options=-csearch_path%3D{schema}"
    with server.begin() as connection:
        connection.execute(text(f"DROP SCHEMA IF EXISTS {schema} CASCADE"))


def restored(copy: Path, url: str) -> str:
    """Return the URL of the copy, in the place of the database where it is on a server."""
    if url.startswith("sqlite"):
        return f"sqlite:///{copy}"
    execute(url, f"DROP SCHEMA {schema_of(url)} CASCADE")
    address = url.replace("+psycopg", "")
    subprocess.run(["pg_restore", "--dbname", address, copy], check=True)
    return url


_POSTGRESQL = {
    "columns": "SELECT c.relname, a.attnum, a.attname, format_type(a.atttypid, a.atttypmod), "
    "a.attnotnull, pg_get_expr(d.adbin, d.adrelid) FROM pg_attribute a "
    "JOIN pg_class c ON c.oid = a.attrelid AND c.relkind IN ('r', 'v') "
    "LEFT JOIN pg_attrdef d ON d.adrelid = c.oid AND d.adnum = a.attnum "
    "WHERE a.attnum > 0 AND c.relnamespace = to_regnamespace(current_schema())",
    "constraints": "SELECT conrelid::regclass::text, conname, contype::text, "
    "pg_get_constraintdef(oid) FROM pg_constraint "
    "WHERE connamespace = to_regnamespace(current_schema())",
    "indexes": "SELECT indexname, replace(indexdef, current_schema() || '.', '') FROM pg_indexes "
    "WHERE schemaname = current_schema()",
    "views": "SELECT viewname, definition FROM pg_views WHERE schemaname = current_schema()",
    "sequences": "SELECT sequencename, last_value, data_type::text FROM pg_sequences "
    "WHERE schemaname = current_schema()",
}

# One query, because the reflection of SQLAlchemy asks several for each table.
_COLUMNS = {
    "sqlite": "SELECT m.name, c.name FROM sqlite_master m, pragma_table_info(m.name) c "
    "WHERE m.type = 'table' AND m.name NOT LIKE 'sqlite\\_%' ESCAPE '\\' ORDER BY m.name, c.cid",
    "postgresql": "SELECT c.relname, a.attname FROM pg_attribute a "
    "JOIN pg_class c ON c.oid = a.attrelid AND c.relkind = 'r' "
    "WHERE a.attnum > 0 AND NOT a.attisdropped "
    "AND c.relnamespace = to_regnamespace(current_schema()) ORDER BY c.relname, a.attnum",
}


def structure(url: str) -> dict[str, list[Any]]:
    """Return tables with columns, types, constraints and options, indexes and views."""
    engine = create_engine(url)
    with engine.begin() as connection:
        found = _of_sqlite(connection) if engine.name == "sqlite" else _of_server(connection)
    engine.dispose()
    return found


def _of_server(connection: Connection) -> dict[str, list[Any]]:
    return {
        part: sorted(map(repr, map(tuple, connection.execute(text(query)))))
        for part, query in _POSTGRESQL.items()
    }


def _of_sqlite(connection: Connection) -> dict[str, list[Any]]:
    statements = connection.exec_driver_sql("SELECT type, name, tbl_name, sql FROM sqlite_master")
    tables = connection.exec_driver_sql(
        "SELECT name, type, ncol, wr, strict FROM pragma_table_list"
    )
    found = {
        # The text holds columns, types, constraints and options, and their order.
        "statements": sorted((*row[:3], _words(row.sql)) for row in statements),
        "tables": sorted(map(tuple, tables)),
    }
    names = [row[0] for row in found["tables"] if row[1] == "table"]
    for pragma in ("table_xinfo", "foreign_key_list", "index_list"):
        for name in names:
            rows = connection.exec_driver_sql(f"PRAGMA {pragma}({name})").all()
            # The first number counts in the order in which they were made.
            found[f"{pragma} {name}"] = sorted(repr(tuple(row)[1:]) for row in rows)
    return found


def _words(sql: str | None) -> str:
    text = re.sub(r"\s+", " ", (sql or "").replace('"', ""))
    return re.sub(r" ?([(),]) ?", r"\1", text).strip()


def contents(url: str, columns: dict[str, tuple[str, ...]]) -> dict[str, list[str]]:
    """Return the rows of the tables, as text that tells any two values apart."""
    engine = create_engine(url)
    with engine.begin() as connection:
        found = {
            table: sorted(
                repr(tuple(row))
                for row in connection.execute(text(f"SELECT {', '.join(names)} FROM {table}"))
            )
            for table, names in columns.items()
        }
    engine.dispose()
    return found


def columns(url: str) -> dict[str, tuple[str, ...]]:
    """Return the names of the columns of each table except the version."""
    engine = create_engine(url)
    with engine.begin() as connection:
        pairs = connection.execute(text(_COLUMNS[engine.name])).all()
    engine.dispose()
    found: dict[str, tuple[str, ...]] = {}
    for table, column in pairs:
        if table != "alembic_version":
            found[table] = (*found.get(table, ()), column)
    return found
