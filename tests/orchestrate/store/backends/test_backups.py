"""Before an upgrade everything is copied, unless the user says otherwise."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import Engine

from orchestrate.store import StoreError, StoreUnavailableError
from orchestrate.store.migrations.upgrade import upgrade
from tests.orchestrate.store.migrations.released import restore
from tests.orchestrate.store.places import backups, execute, file_of, schema_of
from tests.orchestrate.store.structure import columns, contents, structure


def _backup_url(url: str, name: str) -> str:
    return f"sqlite:///{name}" if url.startswith("sqlite") else _in_schema(url, name)


def _in_schema(url: str, schema: str) -> str:
    return f"{url.rpartition('%3D')[0]}%3D{schema}"


def test_the_backup_is_what_was_there(old: str, drop: Callable[[str], None]) -> None:
    before, kept = structure(old), columns(old)
    rows = contents(old, kept)
    name = upgrade(old).backup
    assert name is not None
    drop(name)
    backup = _backup_url(old, name)
    assert structure(backup) == before
    assert contents(backup, kept) == rows
    assert upgrade(backup, backup=False).changed


def test_a_backup_replaces_no_other(old: str, version: int, drop: Callable[[str], None]) -> None:
    if old.startswith("sqlite"):
        taken = f"{file_of(old)}.v{version}-backup"
        Path(taken).write_text("precious")
    else:
        taken = f"{schema_of(old)}_v{version}_backup"
        drop(taken)
        execute(old, f'CREATE SCHEMA "{taken}"')
    name = upgrade(old).backup
    assert name is not None
    drop(name)
    assert name in (f"{taken}-2", f"{taken}_2")
    if old.startswith("sqlite"):
        assert Path(taken).read_text() == "precious"


def test_a_backup_can_be_left_out(old: str) -> None:
    done = upgrade(old, backup=False)
    assert done.changed
    assert done.backup is None
    assert backups(old) == []


def test_a_full_disk_refuses_the_backup(sqlite_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    restore(1, sqlite_url)
    before = structure(sqlite_url)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("orchestrate.store.backends.sqlite_backup.os.fsync", full)
    with pytest.raises(StoreUnavailableError, match=r"No space left.*--no-backup"):
        upgrade(sqlite_url)
    assert structure(sqlite_url) == before
    assert backups(sqlite_url) == []


def test_a_user_who_cannot_make_a_backup_is_told(postgresql_url: str, server: Engine) -> None:
    restore(1, postgresql_url)
    schema, role = schema_of(postgresql_url), f"guest_{schema_of(postgresql_url)[-8:]}"
    named = (
        "SELECT relname FROM pg_class WHERE relkind IN ('r', 'v') "
        "AND relnamespace = to_regnamespace(current_schema())"
    )
    with server.begin() as connection:
        connection.exec_driver_sql(f"CREATE ROLE {role}")
        connection.exec_driver_sql(f"ALTER SCHEMA {schema} OWNER TO {role}")
        for (name,) in execute(postgresql_url, named):
            connection.exec_driver_sql(f"ALTER TABLE {schema}.{name} OWNER TO {role}")
    try:
        guest = f"{postgresql_url}%20-crole%3D{role}"
        with pytest.raises(StoreError, match=r"right to create a schema.*--no-backup"):
            upgrade(guest)
        assert upgrade(guest, backup=False).changed
    finally:
        with server.begin() as connection:
            connection.exec_driver_sql(f"REASSIGN OWNED BY {role} TO CURRENT_USER")
            connection.exec_driver_sql(f"DROP OWNED BY {role}")
            connection.exec_driver_sql(f"DROP ROLE {role}")
