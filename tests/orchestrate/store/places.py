"""Place of a database, and the files beside it."""

from __future__ import annotations

import subprocess
from pathlib import Path

from sqlalchemy import create_engine, text
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


def restored(copy: Path, url: str) -> str:
    """Return the URL of the copy, in the place of the database where it is on a server."""
    if url.startswith("sqlite"):
        return f"sqlite:///{copy}"
    execute(url, f"DROP SCHEMA {schema_of(url)} CASCADE")
    address = url.replace("+psycopg", "")
    subprocess.run(["pg_restore", "--dbname", address, copy], check=True)
    return url
