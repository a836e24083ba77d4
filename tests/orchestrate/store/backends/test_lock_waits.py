"""Waits for locks of others: said, bounded, and caused by nothing that reads."""

from __future__ import annotations

import fcntl
import logging
import os
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import psycopg
import pytest
from sqlalchemy.engine import make_url

from orchestrate.store import Store, StoreUnavailableError
from orchestrate.store.backends import base, file_locks, postgresql
from tests.orchestrate.store.fakes import LAUNCH, Spec
from tests.orchestrate.store.places import file_of, schema_of

PATIENCE = 0.6
LOCKED = "LOCK TABLE store_lock IN SHARE ROW EXCLUSIVE MODE"
ROW = "SELECT * FROM launch FOR UPDATE"


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Announce a wait after a fraction of the two seconds."""
    for module in (base, file_locks, postgresql):
        monkeypatch.setattr(module, "ANNOUNCE_SECONDS", 0.2)
    monkeypatch.setattr(postgresql, "_WATCH_SECONDS", 0.05)


@contextmanager
def session(url: str, name: str = "meddler") -> Iterator[psycopg.Connection]:
    parsed = make_url(url)
    with psycopg.connect(
        host=parsed.host,
        port=parsed.port,
        user=parsed.username,
        password=parsed.password,
        dbname=parsed.database,
        application_name=name,
        options=f"-csearch_path={schema_of(url)}",
    ) as connection:
        yield connection


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [one.getMessage() for one in caplog.records if one.levelno == logging.WARNING]


@pytest.mark.parametrize("sql", [LOCKED, ROW])
def test_a_lock_of_a_session_is_said_and_ends_the_wait(
    sql: str, postgresql_url: str, caplog: pytest.LogCaptureFixture
) -> None:
    with Store.open(postgresql_url, patience=PATIENCE) as store:
        launch = store.begin_launch(LAUNCH)
        with session(postgresql_url) as meddler:
            meddler.execute(sql)  # type: ignore[arg-type]
            who = f"process {meddler.info.backend_pid} of the user {meddler.info.user} (meddler)"
            with pytest.raises(StoreUnavailableError) as caught:
                store.heartbeat(launch) if sql == ROW else store.recover()
        assert f"{who} has held a lock on it for" in str(caught.value)
        assert not caught.value.transient, "it has waited long enough"
        assert warnings(caplog) == [f"waiting for a lock of {store.safe_url}, which {who} holds"]
        assert store.recover() == 0, "the connection works afterwards"


def test_a_lock_that_ends_in_time_costs_nothing(
    postgresql_url: str, caplog: pytest.LogCaptureFixture
) -> None:
    with Store.open(postgresql_url) as store, session(postgresql_url) as meddler:
        launch = store.begin_launch(LAUNCH)
        meddler.execute(LOCKED)  # type: ignore[arg-type]
        thread = threading.Thread(target=store.register, args=(launch, [Spec()]))
        thread.start()
        while not warnings(caplog):
            assert thread.is_alive()
        meddler.rollback()
        thread.join()
        assert store.register(launch, [Spec()]).todo == [Spec().trial_key]
    assert len(warnings(caplog)) == 1


def test_a_launch_that_holds_it_gets_its_whole_lease(
    postgresql_url: str, caplog: pytest.LogCaptureFixture
) -> None:
    """It may be dead: then the server ends it when the lease is over."""
    store = Store.open(postgresql_url, lease_seconds=2.0, patience=0.3)
    with store, session(postgresql_url, "dopt launch 123") as sleeper:
        sleeper.execute(LOCKED)  # type: ignore[arg-type]
        with pytest.raises(StoreUnavailableError, match=r"has held a lock on it for ([2-9]|\d\d)"):
            store.recover()
    assert len(warnings(caplog)) == 1


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT pg_advisory_lock(hashtext('dopt.store.' || current_schema()))",
        "SELECT pg_advisory_lock_shared(hashtext('dopt.store.' || current_schema()))",
        "SELECT * FROM store_lock",
        "SELECT * FROM store_lock FOR UPDATE",
        "SELECT * FROM trial FOR KEY SHARE",
        "ANALYZE trial",
    ],
)
def test_no_select_stops_a_launch(sql: str, postgresql_url: str) -> None:
    with Store.open(postgresql_url, patience=PATIENCE) as store:
        launch = store.begin_launch(LAUNCH)
        with session(postgresql_url) as reader:
            reader.execute(sql)  # type: ignore[arg-type]
            (claim,) = store.claim(launch, store.register(launch, [Spec()]).todo)
            store.recover()
            assert store.release(launch) == 1
            assert claim.attempt == 1


def test_a_role_that_reads_everything_cannot_take_the_lock(postgresql_url: str) -> None:
    schema = schema_of(postgresql_url)
    role = f"reader_{schema}"
    Store.open(postgresql_url).close()
    with session(postgresql_url) as owner:
        owner.execute(f"CREATE ROLE {role}")  # type: ignore[arg-type]
        owner.execute(f"GRANT USAGE ON SCHEMA {schema} TO {role}")  # type: ignore[arg-type]
        owner.execute(f"GRANT SELECT ON ALL TABLES IN SCHEMA {schema} TO {role}")  # type: ignore[arg-type]
        owner.execute(f"SET ROLE {role}")  # type: ignore[arg-type]
        with pytest.raises(psycopg.errors.InsufficientPrivilege):
            owner.execute(LOCKED)  # type: ignore[arg-type]
        owner.rollback()


def test_a_schema_of_another_program_gets_no_table(postgresql_url: str) -> None:
    with session(postgresql_url) as owner:
        owner.execute("CREATE TABLE notes (line text)")
        owner.commit()
        with pytest.raises(Exception, match="not a results database"):
            Store.open(postgresql_url)
        found = owner.execute("SELECT to_regclass('store_lock')").fetchone()
    assert found == (None,)


def test_a_locked_file_is_said_and_ends_the_wait(
    sqlite_url: str, caplog: pytest.LogCaptureFixture
) -> None:
    with Store.open(sqlite_url, patience=PATIENCE) as store:
        with closing(sqlite3.connect(file_of(sqlite_url), isolation_level=None)) as meddler:
            meddler.execute("BEGIN IMMEDIATE")
            named = rf"process {os.getpid()} has locked it for more than 0.6 s; end it"
            with pytest.raises(StoreUnavailableError, match=named) as caught:
                store.begin_launch(LAUNCH)
        assert not caught.value.transient, "it has waited long enough"
        (said,) = warnings(caplog)
        assert said.startswith("waiting for a lock of ")
        assert said.endswith(f"which process {os.getpid()} holds")
        assert store.begin_launch(LAUNCH) == 1


def test_a_creation_that_hangs_is_said_and_ends_the_wait(
    sqlite_url: str, caplog: pytest.LogCaptureFixture
) -> None:
    Store.open(sqlite_url).close()
    lock = Path(f"{file_of(sqlite_url)}-locks") / "create"
    with lock.open("w") as hung:
        fcntl.flock(hung, fcntl.LOCK_EX)
        named = rf"process {os.getpid()} has locked it for more than 0.6 s; end it"
        with pytest.raises(StoreUnavailableError, match=named):
            Store.open(sqlite_url, patience=PATIENCE)
    assert len(warnings(caplog)) == 1
    Store.open(sqlite_url).close()


@pytest.mark.parametrize("patience", [0.05, 0.5])
def test_a_free_file_is_locked_at_once(
    tmp_path: Path, patience: float, caplog: pytest.LogCaptureFixture
) -> None:
    taken: list[float] = []

    def locked(seconds: float) -> bool:
        taken.append(seconds)
        return True

    file_locks.patiently(locked, patience, tmp_path, tmp_path)
    assert taken == [min(0.2, patience)]
    assert not warnings(caplog)
