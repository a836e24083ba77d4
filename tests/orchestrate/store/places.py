"""Place of a database, and the files beside it."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import create_engine, text
from sqlalchemy.engine import make_url


def backups(url: str) -> list[object]:
    if url.startswith("sqlite"):
        return list(file_of(url).parent.glob("*backup*"))
    names = execute(url, "SELECT nspname FROM pg_namespace")
    return [name for (name,) in names if str(name).startswith(f"{schema_of(url)}_")]


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
