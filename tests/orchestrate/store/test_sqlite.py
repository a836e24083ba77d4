"""Behaviour of a file alone: locks, permissions, damage, a full disk."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import event

from orchestrate.store import Claim, Reader, Store, StoreError, StoreUnavailableError, sqlite
from orchestrate.store.maintenance import examine
from orchestrate.store.sqlite import _is_read_only, read_address
from tests.orchestrate.store.databases import file_of
from tests.orchestrate.store.fakes import HORIZON, LAUNCH, RUN, Spec, begin, result, run_all
from tests.orchestrate.store.processes import hear, kill, run_and_stop, running, without_rights


@pytest.fixture
def url(sqlite_url: str) -> str:
    return sqlite_url


@pytest.fixture
def path(url: str) -> Path:
    return file_of(url)


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
        with Reader.open(url) as reader:
            assert reader.rows("SELECT state FROM launch")[0].state == "lost"
    finally:
        os.close(wakes)
        os.close(waits)
        os.waitpid(child, 0)


def test_a_launch_that_could_not_begin_leaves_no_lock(
    store: Store, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hold = store._backend.hold

    def fail(*given: Any) -> None:
        hold(*given)
        raise OSError(28, "no space left")

    monkeypatch.setattr(store._backend, "hold", fail)
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
    _, (claim,) = begin(store, Spec())
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


@pytest.mark.parametrize("side", ["store", "reader"])
def test_a_file_that_is_no_database_any_more_is_damaged(tmp_path: Path, side: str) -> None:
    """Whoever has opened it gave the right file: it is damaged, which another copy may mend."""
    path = tmp_path / "results.db"
    url = f"sqlite:///{path}"
    with Store.open(url) as store, Reader.open(url) as reader:
        begin(store)
        with closing(sqlite3.connect(path)) as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        with path.open("r+b") as file:
            file.write(b"notes" * 1000)
        with pytest.raises(StoreUnavailableError, match="not a SQLite database any more") as lost:
            begin(store) if side == "store" else reader.configs()
    assert not lost.value.transient


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("file/results.db", "cannot be made or opened"),
        ("folder", "is a folder, but a file is expected"),
        ("n" * 300, "cannot be made or opened"),
        ("pipe", "is a device, a pipe or a socket, but a file is expected"),
    ],
)
def test_a_place_where_no_file_can_be_is_a_wrong_request(
    tmp_path: Path, place: str, words: str
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    if place in ("folder", "pipe"):
        with pytest.raises(StoreError, match=words):
            Reader.open(f"sqlite:///{tmp_path}/{place}")
    with pytest.raises(StoreError, match=words) as caught:
        Store.open(f"sqlite:///{tmp_path}/{place}")
    assert {one.name for one in tmp_path.iterdir()} == {"file", "folder", "pipe"}
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
    assert len(reader.rows("SELECT * FROM trajectory")) == 1
    with store._backend.engine.connect() as connection:
        connection.connection.driver_connection.execute("PRAGMA max_page_count = 1000000")  # type: ignore[union-attr]
    assert store.commit(two, result(horizon=5_000), RUN)


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


KEY = Spec().config_key
COMMITTED = 12
FRAME = 24 + 4096


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a database whose writer was killed."""
    folder = tmp_path_factory.mktemp("killed")
    url = f"sqlite:///{folder}/results.db"
    Store.open(url).close()
    with running(run_and_stop, url, COMMITTED) as (process, pipe):
        assert hear(pipe) == "committed"
        kill(process)
    return folder


class TestTornLog:
    @pytest.fixture
    def wal(self, killed: Path, path: Path) -> Path:
        """Return the log of a database whose writer was killed, with all of its trials in it."""
        shutil.copytree(killed, path.parent)
        wal = path.with_name("results.db-wal")
        assert wal.stat().st_size > COMMITTED * FRAME
        return wal

    @pytest.mark.parametrize("seed", range(6))
    @pytest.mark.parametrize("harm", ["truncated", "overwritten", "zeroed to its end"])
    def test_the_commits_before_it_are_kept(
        self, url: str, wal: Path, harm: str, seed: int
    ) -> None:
        data = bytearray(wal.read_bytes())
        numbers = random.Random(seed)
        at = numbers.randrange(len(data))
        if harm == "truncated":
            del data[at:]
        elif harm == "overwritten":
            data[at : at + 100] = numbers.randbytes(len(data[at : at + 100]))
        else:
            data[at:] = bytes(len(data) - at)
        wal.write_bytes(data)
        _check_prefix_and_complete(url, at_most=COMMITTED)

    def test_a_whole_log_is_read_whole(self, url: str, wal: Path) -> None:
        assert wal.exists()
        assert _check_prefix_and_complete(url, at_most=COMMITTED) == COMMITTED

    def test_a_log_that_is_gone_costs_what_was_in_it(self, url: str, wal: Path) -> None:
        wal.unlink()
        assert _check_prefix_and_complete(url, at_most=0) == 0

    def test_a_log_with_the_creation_in_it(self, url: str, path: Path) -> None:
        with running(run_and_stop, url, COMMITTED) as (process, pipe):
            assert hear(pipe) == "committed"
            kill(process)
        with path.with_name("results.db-wal").open("r+b") as file:
            file.truncate(3 * FRAME)
        assert _check_prefix_and_complete(url, at_most=0) == 0


def _check_prefix_and_complete(url: str, at_most: int) -> int:
    """Return how many trials were left, always the first ones, whole; run the others."""
    with Store.open(url) as store, Reader.open(url) as reader:
        assert [one for one in examine(url) if one.severity == "error"] == []
        done = len(reader.rows("SELECT * FROM trial WHERE status = 'done'"))
        assert done <= at_most
        assert len(reader.rows("SELECT * FROM step")) == done * HORIZON
        if done:
            assert reader.curves(KEY).seeds.tolist() == list(range(done))
        store.recover()
        launch = store.begin_launch(LAUNCH)
        todo = store.register(launch, [Spec(seed) for seed in range(2 * COMMITTED)]).todo
        assert len(todo) == 2 * COMMITTED - done
        for claim in store.claim(launch, todo):
            assert store.commit(claim, result(claim.trial_id), RUN)
        losses = [result(trial_id).loss for trial_id in range(1, 2 * COMMITTED + 1)]
        np.testing.assert_array_equal(reader.curves(KEY).values, losses)
        store.end_launch(launch, "done")
    return done


@pytest.fixture(scope="module")
def sixty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a database with sixty trials."""
    folder = tmp_path_factory.mktemp("sixty")
    run_all(f"sqlite:///{folder}/results.db", *map(Spec, range(60)))
    return folder


class TestDamagedFile:
    @pytest.fixture
    def damaged(self, sixty: Path, path: Path) -> Callable[[str], None]:
        """Return a function that overwrites the first page of a table."""
        shutil.copytree(sixty, path.parent)

        def damage(table: str) -> None:
            connection = sqlite3.connect(path)
            root, size = connection.execute(
                "SELECT rootpage, page_size FROM sqlite_master, pragma_page_size WHERE name = ?",
                (table,),
            ).fetchone()
            connection.close()
            with path.open("r+b") as file:
                file.seek((root - 1) * size)
                file.write(random.Random(0).randbytes(size))

        return damage

    @pytest.mark.parametrize("table", ["step", "curve", "trial", "trajectory", "attempt"])
    def test_the_doctor_says_so(self, url: str, damaged: Callable[[str], None], table: str) -> None:
        damaged(table)
        first = examine(url)[0]
        assert first.severity == "error"
        assert "damaged" in first.sentence
        assert "restore a copy" in first.advice

    def test_a_reader_gives_no_wrong_number(self, url: str, damaged: Callable[[str], None]) -> None:
        damaged("curve")
        with Reader.open(url) as reader:
            assert len(reader.trials(KEY)) == 60
            with pytest.raises(StoreUnavailableError, match="the file is damaged; restore") as one:
                reader.curves(KEY)
        assert not one.value.transient

    def test_a_writer_stops(self, url: str, damaged: Callable[[str], None]) -> None:
        damaged("trial")
        with Store.open(url) as store:
            launch = store.begin_launch(LAUNCH)
            with pytest.raises(StoreUnavailableError, match="the file is damaged") as caught:
                store.register(launch, [Spec(0)])
        assert not caught.value.transient

    @pytest.mark.parametrize("side", [Store, Reader])
    def test_a_damaged_table_of_tables(
        self, url: str, path: Path, damaged: Callable[[str], None], side: type[Store | Reader]
    ) -> None:
        assert damaged
        with path.open("r+b") as file:
            file.seek(100)
            file.write(random.Random(0).randbytes(3996))
        with pytest.raises(StoreError, match="damaged"):
            side.open(url)
        with pytest.raises(StoreError, match="damaged"):
            examine(url)


def _begin_launch(url: str) -> str:
    with Store.open(url) as store:
        store.begin_launch(LAUNCH)
    return "begun"


def _count_done(url: str) -> int:
    with Reader.open(url) as reader:
        return len(reader.curves(KEY).seeds)


class TestReadOnly:
    """The processes here give up the rights of root, for whom nothing is read-only."""

    @pytest.fixture
    def folder(self) -> Iterator[Path]:
        """Return a folder that everybody may enter; the folders of pytest are private."""
        folder = Path(tempfile.mkdtemp(prefix="dopt-read-only-"))
        folder.chmod(0o777)
        yield folder
        folder.chmod(0o777)
        shutil.rmtree(folder)

    @pytest.fixture
    def path(self, folder: Path) -> Path:
        return folder / "results.db"

    @pytest.fixture
    def url(self, path: Path) -> str:
        return f"sqlite:///{path}"

    @pytest.fixture
    def filled(self, url: str, folder: Path) -> str:
        run_all(url, Spec(0), Spec(1))
        for path in folder.rglob("*"):
            path.chmod(0o777 if path.is_dir() else 0o666)
        return url

    @staticmethod
    def answer(side: Callable[[str], object], url: str) -> object:
        with running(without_rights, side, url) as (_, pipe):
            return hear(pipe)

    def test_a_file(self, filled: str, path: Path) -> None:
        path.chmod(0o444)
        error = self.answer(_begin_launch, filled)
        assert isinstance(error, StoreUnavailableError)
        assert f"because {path} is read-only: make it writable or give another path" in str(error)
        assert not error.transient
        path.chmod(0o666)
        assert self.answer(_begin_launch, filled) == "begun"

    def test_a_file_that_was_read_meanwhile(self, filled: str, path: Path) -> None:
        path.chmod(0o444)
        assert self.answer(_count_done, filled) == 2
        path.chmod(0o666)
        # The files that the reader made are as read-only as the database was.
        assert "results.db-wal is read-only" in str(self.answer(_begin_launch, filled))
        for suffix in ("-wal", "-shm"):
            path.with_name(f"results.db{suffix}").chmod(0o666)
        assert self.answer(_begin_launch, filled) == "begun"

    def test_a_file_and_its_folder(self, filled: str, path: Path) -> None:
        for one in (path, path.with_name("results.db-locks"), path.parent):
            one.chmod(0o555)
        assert self.answer(_count_done, filled) == 2
        error = self.answer(_begin_launch, filled)
        assert isinstance(error, StoreUnavailableError)
        assert not error.transient
        assert len(str(error).splitlines()) == 1

    def test_a_folder_without_a_database(self, url: str, folder: Path) -> None:
        folder.chmod(0o555)
        error = self.answer(_begin_launch, url)
        assert isinstance(error, StoreError)
        assert "cannot be made or opened (Permission denied): make its folder wri" in str(error)
        assert list(folder.iterdir()) == []

    def test_a_folder_with_a_log_of_a_killed_writer(self, url: str, folder: Path) -> None:
        Store.open(url).close()
        with running(run_and_stop, url, 2) as (process, pipe):
            assert hear(pipe) == "committed"
            kill(process)
        for one in folder.rglob("*"):
            one.chmod(0o555 if one.is_dir() else 0o444)
        folder.chmod(0o555)
        assert self.answer(_count_done, url) == 2

    def test_locks_of_somebody_else(self, filled: str, path: Path) -> None:
        path.with_name("results.db-locks").chmod(0o555)
        (path.with_name("results.db-locks") / "create").chmod(0o444)
        error = self.answer(_begin_launch, filled)
        assert isinstance(error, StoreError)
        assert "results.db-locks/create" in str(error)


def test_a_long_reader_holds_up_nobody_and_the_log_shrinks_afterwards(
    url: str, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit = 2**18
    monkeypatch.setattr(sqlite, "MAX_LOG_BYTES", limit)
    wal = path.with_name("results.db-wal")
    specs = [Spec(seed, horizon=300) for seed in range(120)]
    with Store.open(url) as store, Reader.open(url) as reader:
        _, claims = begin(store, *specs)
        assert store.commit(claims[0], result(0, 300), RUN)
        with reader.moment() as moment:
            assert len(moment.rows("SELECT * FROM step")) == 300
            for claim in claims[1:-2]:
                assert store.commit(claim, result(0, 300), RUN)
            assert len(moment.rows("SELECT * FROM step")) == 300
            assert wal.stat().st_size > 4 * limit
        for claim in claims[-2:]:
            assert store.commit(claim, result(0, 300), RUN)
        assert wal.stat().st_size <= limit + 2 * 300 * 100
        assert len(reader.rows("SELECT * FROM step")) == 120 * 300
