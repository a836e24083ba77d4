"""Before an upgrade everything is copied, unless the user says otherwise."""

from __future__ import annotations

from pathlib import Path

import pytest
from sqlalchemy.engine import make_url

from orchestrate.store import StoreError, StoreUnavailableError
from orchestrate.store.upgrade import upgrade
from tests.orchestrate.store.migrations.released import VERSIONS, restore
from tests.orchestrate.store.places import backups, file_of, restored, schema_of
from tests.orchestrate.store.structure import columns, contents, structure


def test_the_backup_is_what_was_there(old: str) -> None:
    before, kept = structure(old), columns(old)
    rows = contents(old, kept)
    name = upgrade(old).backup
    assert name is not None
    backup = restored(Path(name), old)
    assert structure(backup) == before
    assert contents(backup, kept) == rows
    assert upgrade(backup, backup=False).changed


def test_a_backup_replaces_no_other(old: str, version: int) -> None:
    if old.startswith("sqlite"):
        taken, free = f"{file_of(old)}.v{version}-backup", f"{file_of(old)}.v{version}-backup-2"
    else:
        base = Path.cwd() / f"{make_url(old).database}-{schema_of(old)}.v{version}-backup"
        taken, free = f"{base}.dump", f"{base}-2.dump"
    Path(taken).write_text("precious")
    assert upgrade(old).backup == free
    assert Path(taken).read_text() == "precious"


def test_a_backup_can_be_left_out(old: str) -> None:
    done = upgrade(old, backup=False)
    assert done.changed
    assert done.backup is None
    assert backups(old) == []


def test_a_full_disk_refuses_the_backup(sqlite_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    restore(VERSIONS[-1], sqlite_url)
    before = structure(sqlite_url)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("orchestrate.store.backends.backups.os.fsync", full)
    with pytest.raises(StoreUnavailableError, match=r"No space left.*--no-backup"):
        upgrade(sqlite_url)
    assert structure(sqlite_url) == before
    assert backups(sqlite_url) == []


OLDER = """#!/bin/sh
echo "pg_dump: error: aborting because of server version mismatch" >&2
echo "pg_dump: detail: server version: 16.1; pg_dump version: 15.2" >&2
exit 1
"""


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("", "pg_dump, which is not installed: .*, or give --no-backup"),
        (OLDER, r"older than the server .*16\.1; .*15\.2\).* or give --no-backup"),
    ],
)
def test_a_server_without_a_program_that_fits_is_upgraded_without_a_backup_alone(
    postgresql_url: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    program: str,
    said: str,
) -> None:
    restore(VERSIONS[-1], postgresql_url)
    before = structure(postgresql_url)
    if program:
        (tmp_path / "pg_dump").write_text(program)
        (tmp_path / "pg_dump").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(StoreError, match=said):
        upgrade(postgresql_url)
    assert structure(postgresql_url) == before
    assert backups(postgresql_url) == []
    assert upgrade(postgresql_url, backup=False).changed
