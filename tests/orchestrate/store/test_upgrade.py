"""Every released schema becomes the newest one, whole or not at all, on every database."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ProgrammingError

from orchestrate.store import (
    LaunchAliveError,
    NoDatabaseError,
    Reader,
    SchemaVersionError,
    Store,
    StoreError,
    StoreUnavailableError,
)
from orchestrate.store import maintenance as migration
from orchestrate.store.maintenance import upgrade
from orchestrate.store.schema import OLDEST, SCHEMA_VERSION
from orchestrate.store.sqlite import LaunchLocks
from tests.orchestrate.store.conftest import each_version
from tests.orchestrate.store.databases import (
    backups,
    columns,
    contents,
    execute,
    file_of,
    restored,
    schema_of,
    structure,
)
from tests.orchestrate.store.fakes import LAUNCH, Spec
from tests.orchestrate.store.processes import CLEAN, hear, kill, running, upgrade_and_tell
from tests.orchestrate.store.released import VERSIONS, restore


@pytest.fixture
def other_url(tmp_path: Path, url: str, request: pytest.FixtureRequest) -> str:
    """Return the URL of nothing, of the same kind."""
    if url.startswith("sqlite"):
        return f"sqlite:///{tmp_path}/other/results.db"
    return str(request.getfixturevalue("another_postgresql_url"))


def test_there_are_statements_for_each_version_and_one_database() -> None:
    assert list(migration.STATEMENTS) == list(range(OLDEST + 1, SCHEMA_VERSION + 1))
    assert list(range(OLDEST, SCHEMA_VERSION)) == VERSIONS


@each_version
@pytest.mark.parametrize("side", [Store, Reader])
def test_an_older_one_is_refused_with_the_command(old: str, side: type[Store | Reader]) -> None:
    with pytest.raises(SchemaVersionError, match="an older program") as caught:
        side.open(old)
    assert "'python -m orchestrate upgrade --db " in str(caught.value)
    assert old.rpartition("options=")[2].replace("sqlite:", "") in str(caught.value)


@each_version
def test_upgraded_equals_created(old: str, other_url: str) -> None:
    upgrade(old)
    Store.open(other_url).close()
    upgraded, created = structure(old), structure(other_url)
    for database in (upgraded, created):
        database.pop("sequences", None)  # one has handed out numbers
    assert upgraded == created


@each_version
def test_every_row_stays_as_it_was(old: str, version: int) -> None:
    kept = _kept(old)
    before = contents(old, kept)
    assert len(before["step"]) == 125
    done = upgrade(old)
    assert (done.before, done.after) == (version, SCHEMA_VERSION)
    assert contents(old, kept) == before
    with Reader.open(old) as reader:
        assert reader.schema_version() == str(SCHEMA_VERSION)
        assert sum(config.n_done for config in reader.configs()) == 4


def _kept(url: str) -> dict[str, tuple[str, ...]]:
    """Return the columns of the tables that the upgrade keeps."""
    return {name: names for name, names in columns(url).items() if name != "live_step"}


@each_version
def test_every_configuration_gets_its_label(old: str) -> None:
    upgrade(old)
    with Reader.open(old) as reader:
        found = [row[0] for row in reader.rows("SELECT label FROM config ORDER BY config_id")]
        shown = {row[0] for row in reader.rows("SELECT label FROM v_curve_stats")}
    assert found == [
        "random, adam, horizon 25, depth 1, width 2",
        "random, adam, γ=30, horizon 25, state_limit=5, depth 1, width 2",
        "uniform, adam, horizon 25, depth 1, width 2",
    ]
    assert shown == set(found)


def test_the_label_of_a_class_that_is_not_known_stays(old: str) -> None:
    execute(old, "UPDATE config SET label = 'stored'")
    gone = "replace(config_json, '\"uniform\"', '\"gone\"')"
    execute(old, f"UPDATE config SET config_json = {gone}")
    upgrade(old)
    with Reader.open(old) as reader:
        found = [row[0] for row in reader.rows("SELECT label FROM config ORDER BY config_id")]
    assert found[0] == "random, adam, horizon 25, depth 1, width 2"
    assert found[2] == "stored"


@each_version
def test_a_launch_goes_on_after_it(old: str) -> None:
    upgrade(old)
    with Store.open(old) as store:
        assert store.recover() == 2
        launch = store.begin_launch(LAUNCH)
        assert launch == 4
        assert store.register(launch, [Spec()]).todo == [Spec().trial_key]
        store.end_launch(launch, "done", exit_code=0)
    with Reader.open(old) as reader:
        assert reader.rows("SELECT exit_code FROM launch ORDER BY launch_id")[3][0] == 0


def test_a_failure_in_the_middle_changes_nothing(old: str, monkeypatch: pytest.MonkeyPatch) -> None:
    failing = ("DELETE FROM step", "SELECT nonsense FROM nowhere")
    last = (*migration.STATEMENTS[SCHEMA_VERSION], *failing)
    monkeypatch.setitem(migration.STATEMENTS, SCHEMA_VERSION, last)
    before, kept = structure(old), columns(old)
    rows = contents(old, kept)
    with pytest.raises((StoreUnavailableError, ProgrammingError), match="nowhere"):
        upgrade(old)
    assert structure(old) == before
    assert contents(old, kept) == rows
    assert backups(old) == []


def test_a_living_launch_is_left_alone(old: str) -> None:
    before = structure(old)
    with ExitStack() as stack:
        _revive(old, stack)
        with pytest.raises(LaunchAliveError, match=r"Launch 3 .* on laptop.* is running"):
            upgrade(old)
    assert structure(old) == before


def _revive(url: str, stack: ExitStack) -> None:
    """Let the launch that was killed count as alive."""
    if url.startswith("sqlite"):
        ((token,),) = execute(url, "SELECT token FROM launch WHERE state = 'running'")
        folder = file_of(url).with_name(f"{file_of(url).name}-locks")
        folder.mkdir()
        locks = LaunchLocks(folder)
        locks.acquire(str(token))
        stack.callback(locks.close)
    else:
        lease = "extract(epoch FROM clock_timestamp()) + 600"
        execute(url, f"UPDATE launch SET lease_until = {lease} WHERE state = 'running'")


def test_of_two_at_once_one_finds_nothing_to_do(old: str) -> None:
    barrier = CLEAN.Barrier(2)
    with ExitStack() as stack:
        pipes = [stack.enter_context(running(upgrade_and_tell, old, barrier))[1] for _ in range(2)]
        assert sorted(hear(pipe) for pipe in pipes) == ["nothing to do", "upgraded"]
    with Reader.open(old) as reader:
        assert len(reader.rows("SELECT * FROM step")) == 125


def test_death_in_the_middle_changes_nothing(old: str) -> None:
    before, kept = structure(old), columns(old)
    rows = contents(old, kept)
    with running(upgrade_and_tell, old, None, True) as (process, pipe):
        assert hear(pipe) == "half"
        kill(process)
    assert structure(old) == before
    assert contents(old, kept) == rows
    done = upgrade(old)
    assert done.changed


def test_the_newest_is_left_alone_and_a_newer_refused(store: Store, url: str) -> None:
    assert not upgrade(store.safe_url).changed
    with store._backend.transaction() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '99'")
    for open_ in (upgrade, Store.open, Reader.open):
        with pytest.raises(SchemaVersionError, match=r"a newer program.*update the program"):
            open_(url)


@pytest.mark.parametrize("open_", [Store.open, Reader.open, upgrade])
def test_one_that_is_too_old_is_refused_with_what_to_do(
    store: Store, url: str, open_: Callable[[str], object]
) -> None:
    with store._backend.transaction() as connection:
        connection.exec_driver_sql(f"UPDATE alembic_version SET version_num = '{OLDEST - 1}'")
    before = structure(url)
    with pytest.raises(SchemaVersionError, match="export it with the release of this program"):
        open_(url)
    assert structure(url) == before


def test_an_empty_database_is_created(url: str) -> None:
    if url.startswith("sqlite"):
        file_of(url).parent.mkdir()
        file_of(url).touch()
    done = upgrade(url)
    assert (done.before, done.after, done.backup) == (None, SCHEMA_VERSION, None)
    Reader.open(url).close()


def test_nothing_is_made_where_there_is_no_file(sqlite_url: str) -> None:
    with pytest.raises(NoDatabaseError):
        upgrade(sqlite_url)
    assert not file_of(sqlite_url).parent.exists()


@pytest.mark.parametrize("open_", [Store.open, Reader.open, upgrade])
@pytest.mark.parametrize("table", ["album", "alembic_version"])
def test_a_database_of_another_program_is_left_alone(
    tmp_path: Path, table: str, open_: Callable[[str], object]
) -> None:
    path = tmp_path / "other.db"
    execute(f"sqlite:///{path}", f"CREATE TABLE {table} (version_num VARCHAR(32) NOT NULL)")
    execute(f"sqlite:///{path}", f"INSERT INTO {table} VALUES ('ae1027a6acf0')")
    before = path.read_bytes()
    with pytest.raises(SchemaVersionError, match="not a results database"):
        open_(f"sqlite:///{path}")
    assert path.read_bytes() == before


@each_version
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


def test_a_full_disk_refuses_the_backup(sqlite_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    restore(VERSIONS[-1], sqlite_url)
    before = structure(sqlite_url)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("orchestrate.store.backend.os.fsync", full)
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
    postgresql_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, said: str
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
