"""Faults of a file: torn, damaged, read-only, or read for long."""

from __future__ import annotations

import random
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy.engine import make_url

from orchestrate.store import Claim, Reader, Store, StoreError, StoreUnavailableError
from orchestrate.store.backends import sqlite_engine
from orchestrate.store.doctor import examine
from tests.orchestrate.store.fakes import HORIZON, LAUNCH, RUN, Spec, result
from tests.orchestrate.store.processes import hear, kill, run_and_stop, running, without_rights

KEY = Spec().config_key
COMMITTED = 12
FRAME = 24 + 4096


@pytest.fixture
def url(sqlite_url: str) -> str:
    return sqlite_url


@pytest.fixture
def path(url: str) -> Path:
    return Path(str(make_url(url).database))


class TestTornLog:
    @pytest.fixture
    def wal(self, url: str, path: Path) -> Path:
        """Return the log of a database whose writer was killed, with all of its trials in it."""
        Store.open(url).close()
        with running(run_and_stop, url, COMMITTED) as (process, pipe):
            assert hear(pipe) == "committed"
            kill(process)
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
        done = len(reader.query("SELECT * FROM trial WHERE status = 'done'"))
        assert done <= at_most
        assert len(reader.query("SELECT * FROM step")) == done * HORIZON
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


class TestDamagedFile:
    @pytest.fixture
    def damaged(self, url: str, path: Path) -> Callable[[str], None]:
        """Return a function that overwrites the first page of a table."""
        with Store.open(url) as store:
            launch = store.begin_launch(LAUNCH)
            claims = store.claim(launch, store.register(launch, [Spec(s) for s in range(60)]).todo)
            store.commit_many([(claim, result(claim.trial_id), RUN) for claim in claims])
            store.end_launch(launch, "done")

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
        """Return a folder that everybody may enter; those of pytest are private."""
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
        with Store.open(url) as store:
            launch = store.begin_launch(LAUNCH)
            for claim in store.claim(launch, store.register(launch, [Spec(0), Spec(1)]).todo):
                store.commit(claim, result(claim.trial_id), RUN)
            store.end_launch(launch, "done")
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
    monkeypatch.setattr(sqlite_engine, "MAX_LOG_BYTES", limit)
    wal = path.with_name("results.db-wal")
    specs = [Spec(seed, horizon=300) for seed in range(120)]
    with Store.open(url) as store, Reader.open(url) as reader:
        launch = store.begin_launch(LAUNCH)
        claims = store.claim(launch, store.register(launch, specs).todo)
        assert store.commit(claims[0], result(0, 300), RUN)
        with reader.moment() as moment:
            assert len(moment.rows("SELECT * FROM step")) == 300
            for claim in claims[1:-2]:
                assert store.commit(claim, result(0, 300), RUN)
            assert len(moment.rows("SELECT * FROM step")) == 300
            assert wal.stat().st_size > 4 * limit
        _commit(store, claims[-2:])
        assert wal.stat().st_size <= limit + 2 * 300 * 100
        assert len(reader.query("SELECT * FROM step")) == 120 * 300


def _commit(store: Store, claims: list[Claim]) -> None:
    for claim in claims:
        assert store.commit(claim, result(0, 300), RUN)
