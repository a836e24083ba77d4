"""Behaviour of a file alone: locks, permissions, damage, a full disk."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event
from sqlalchemy.engine import make_url

from orchestrate.store import (
    Claim,
    Reader,
    SchemaVersionError,
    Store,
    StoreError,
    StoreUnavailableError,
    launches,
)
from orchestrate.store.backends.sqlite_engine import _is_read_only, read_address
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, result
from tests.orchestrate.store.processes import eight_open


@pytest.fixture
def url(sqlite_url: str) -> str:
    return sqlite_url


@pytest.fixture
def path(url: str) -> Path:
    return Path(str(make_url(url).database))


def test_tables_are_strict_and_steps_have_no_rowid(store: Store, path: Path) -> None:
    assert store.safe_url.endswith("results.db")
    connection = sqlite3.connect(path)
    tables = connection.execute(
        "SELECT name, strict, wr FROM pragma_table_list "
        "WHERE schema = 'main' AND type = 'table' AND name NOT LIKE 'sqlite%'"
    ).fetchall()
    assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    connection.close()
    assert len(tables) == 10
    assert all(strict for _, strict, _ in tables)
    assert ("step", 1, 1) in tables


def test_curves_are_read_without_a_sort(
    store: Store, take: Callable[..., list[Claim]], reader: Reader
) -> None:
    (claim,) = take(Spec())
    store.commit(claim, result(), RUN)
    with store._backend.transaction() as connection:
        connection.exec_driver_sql("DELETE FROM curve")
    statements: list[tuple[str, object]] = []

    @event.listens_for(reader._engine, "before_cursor_execute")
    def _listen(*call: object) -> None:
        statements.append((str(call[2]), call[3]))

    reader.curves(Spec().config_key)
    statement, parameters = next(one for one in statements if "FROM step" in one[0])
    with reader._engine.begin() as connection:
        plan = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", parameters).all()  # type: ignore[arg-type]
    assert "TEMP B-TREE" not in str(plan)


def test_creation_is_safe_many_times_over(tmp_path: Path) -> None:
    urls = [f"sqlite:///{tmp_path}/{i}.db" for i in range(15)]
    eight_open(urls)
    for url in urls:
        with Store.open(url) as store:
            assert store.begin_launch(LAUNCH) == 9


def test_a_log_that_another_process_deletes_meanwhile_is_not_read_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "results.db-wal"

    def deleted(file: Path, _: int) -> bool:
        file.unlink()
        return False

    def replaced(file: Path, _: int) -> bool:
        (tmp_path / "new").touch()
        (tmp_path / "new").rename(file)
        return False

    for change in (deleted, replaced):
        log.touch()
        monkeypatch.setattr(os, "access", change)
        assert not _is_read_only(log)
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert _is_read_only(log)


def test_a_transaction_locks_before_it_reads(store: Store, path: Path) -> None:
    other = sqlite3.connect(path, timeout=0.0, isolation_level=None)
    with store._backend.transaction(), pytest.raises(sqlite3.OperationalError, match="locked"):
        other.execute("BEGIN IMMEDIATE")
    other.execute("BEGIN IMMEDIATE")
    other.close()


def test_a_closed_store_counts_as_dead(store: Store, url: str) -> None:
    with Store.open(url) as other:
        launch = other.begin_launch(LAUNCH)
        other.claim(launch, other.register(launch, [Spec()]).todo)
        assert store.recover() == 0
    assert store.recover() == 1
    with Reader.open(url) as reader:
        assert reader.query("SELECT state FROM launch")[0].state == "lost"


def test_locks_of_launches_that_ended_are_cleared_away(store: Store, path: Path) -> None:
    folder = path.with_name("results.db-locks")
    launch = store.begin_launch(LAUNCH)
    assert len(list(folder.glob("launch-*"))) == 1
    store.end_launch(launch, "done")
    assert list(folder.glob("launch-*")) == []


def test_a_forked_worker_does_not_keep_the_launch_alive(store: Store, url: str) -> None:
    other = Store.open(url)
    launch = other.begin_launch(LAUNCH)
    other.claim(launch, other.register(launch, [Spec()]).todo)
    waits, wakes = os.pipe()
    child = os.fork()
    if child == 0:  # pragma: no cover
        os.close(wakes)
        os.read(waits, 1)
        os._exit(0)
    try:
        assert store.recover() == 0
        other.close()  # as the kernel does when the parent dies
        assert store.recover() == 1
    finally:
        os.close(wakes)
        os.close(waits)
        os.waitpid(child, 0)


def test_a_launch_that_could_not_begin_leaves_no_lock(
    store: Store, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = launches.begin

    def fail(*given: Any) -> int:
        begin(*given)
        raise OSError(28, "no space left")

    monkeypatch.setattr(launches, "begin", fail)
    descriptors = len(list(Path("/proc/self/fd").iterdir()))
    with pytest.raises(OSError, match="no space left"):
        store.begin_launch(LAUNCH)
    assert len(list(Path("/proc/self/fd").iterdir())) == descriptors
    assert not list(path.with_name("results.db-locks").glob("launch-*"))


def test_a_group_may_share_a_database(tmp_path: Path) -> None:
    mask = os.umask(0o002)
    try:
        with Store.open(f"sqlite:///{tmp_path}/shared/results.db"):
            lock = tmp_path / "shared" / "results.db-locks" / "create"
            assert lock.stat().st_mode & 0o777 == 0o664
    finally:
        os.umask(mask)


def test_two_names_of_one_file_share_their_locks(store: Store, path: Path) -> None:
    launch = store.begin_launch(LAUNCH)
    (claim,) = store.claim(launch, store.register(launch, [Spec()]).todo)
    link = path.parent.parent / "link.db"
    link.symlink_to(path)
    with Store.open(f"sqlite:///{link}") as other:
        assert other.recover() == 0
    assert store.commit(claim, result(), RUN)


def test_a_path_may_hold_any_character(tmp_path: Path) -> None:
    path = tmp_path / "50% of #1 & a b.db"
    with Store.open(f"sqlite:///{path}"), Reader.open(f"sqlite:///{path}") as reader:
        assert reader.configs() == []
    assert path.is_file()


@pytest.mark.parametrize("side", [Store, Reader])
def test_refuses_a_file_that_is_no_database(tmp_path: Path, side: type[Store | Reader]) -> None:
    path = tmp_path / "notes.db"
    path.write_text("Some notes, long enough to be taken for a header of a database. " * 4)
    before = path.read_bytes()
    with pytest.raises(StoreUnavailableError, match="not a SQLite database"):
        side.open(f"sqlite:///{path}")
    assert path.read_bytes() == before


@pytest.mark.parametrize("side", [Store, Reader])
def test_refuses_the_database_of_something_else(tmp_path: Path, side: type[Store | Reader]) -> None:
    path = tmp_path / "other.db"
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE album (title TEXT)")
    connection.close()
    with pytest.raises(SchemaVersionError, match="not a results database"):
        side.open(f"sqlite:///{path}")


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("file/results.db", "cannot be made or opened"),
        ("folder", "is a folder, but a file is expected"),
        ("n" * 300, "cannot be made or opened"),
    ],
)
def test_a_place_where_no_file_can_be_is_a_wrong_request(
    tmp_path: Path, place: str, words: str
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(StoreError, match=words) as caught:
        Store.open(f"sqlite:///{tmp_path}/{place}")
    assert not isinstance(caught.value, StoreUnavailableError)


def test_a_full_disk_loses_nothing_committed(
    store: Store, take: Callable[..., list[Claim]], reader: Reader
) -> None:
    one, two = take(Spec(0), Spec(1, horizon=5_000))
    assert store.commit(one, result(), RUN)
    with store._backend.engine.connect() as connection:
        # The limit stays with the one connection of the pool.
        driver = connection.connection.driver_connection
        assert driver is not None
        (pages,) = driver.execute("PRAGMA page_count").fetchone()
        driver.execute(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(StoreUnavailableError, match="disk is full"):
        store.commit(two, result(horizon=5_000), RUN)
    assert len(reader.query("SELECT * FROM trajectory")) == 1
    with store._backend.engine.connect() as connection:
        connection.connection.driver_connection.execute("PRAGMA max_page_count = 1000000")  # type: ignore[union-attr]
    assert store.commit(two, result(horizon=5_000), RUN)


def test_an_integer_column_refuses_bytes(path: Path, store: Store) -> None:
    assert store.recover() == 0
    connection = sqlite3.connect(path)
    with pytest.raises(sqlite3.IntegrityError, match="cannot store BLOB"):
        connection.execute("INSERT INTO step (trial_id, t) VALUES (1, ?)", (b"12345678",))
    connection.close()


def test_reads_a_medium_where_nothing_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "results.db"
    assert read_address(path).endswith(".db?mode=ro")
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert read_address(path).endswith(".db?mode=ro&immutable=1")
    (tmp_path / "results.db-wal").touch()
    assert read_address(path).endswith(".db?mode=ro")


def test_a_committed_trial_survives_a_power_cut(store: Store) -> None:
    with store._backend.transaction() as connection:
        assert connection.exec_driver_sql("PRAGMA synchronous").scalar_one() == 2  # FULL
