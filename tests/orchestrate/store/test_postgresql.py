"""Behaviour of a server alone: leases on its clock, connections that it ends."""

from __future__ import annotations

import fcntl
import logging
import os
import pickle
import socket
import sqlite3
import threading
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import psycopg
import pytest
from sqlalchemy import Engine, text
from sqlalchemy.engine import make_url

from orchestrate.store import (
    Claim,
    Reader,
    Store,
    StoreUnavailableError,
    backend,
    postgresql,
    sqlite,
)
from orchestrate.store.backend import is_transient
from orchestrate.store.records import Array
from tests.orchestrate.store.conftest import Database
from tests.orchestrate.store.databases import execute, file_of, schema_of
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, begin, result, run_all
from tests.waiting import PATIENCE_SECONDS


@pytest.fixture
def url(postgresql_url: str) -> str:
    return postgresql_url


@pytest.fixture
def sleeper(url: str, open_store: Callable[..., Store]) -> tuple[Store, int, Claim]:
    """Return a launch that claimed a trial and shows no life since, as after SIGSTOP."""
    store = open_store()
    launch, (claim,) = begin(store, Spec())
    end_lease(url, launch)
    return store, launch, claim


def end_lease(url: str, launch: int) -> None:
    """Let the lease of a launch run out, as time does."""
    execute(url, f"UPDATE launch SET lease_until = 0 WHERE launch_id = {launch}")


def test_claims_are_free_after_the_lease(
    store: Store, sleeper: tuple[Store, int, Claim], reader: Reader
) -> None:
    late, launch, claim = sleeper
    assert store.recover() == 1
    assert not late.commit(claim, result(), RUN)
    assert reader.rows("SELECT state FROM launch")[0].state == "lost"
    late.heartbeat(launch)
    assert reader.rows("SELECT state, ended FROM launch")[0].state == "running"


@pytest.mark.parametrize("renew", [Store.heartbeat, lambda late, launch: late.claim(launch, [])])
def test_a_heartbeat_or_a_claim_renews_the_lease(
    store: Store, sleeper: tuple[Store, int, Claim], renew: Callable[[Store, int], object]
) -> None:
    late, launch, claim = sleeper
    renew(late, launch)
    assert store.recover() == 0
    assert late.commit(claim, result(), RUN)


def test_an_ended_connection_costs_one_error(db: Database) -> None:
    (claim,) = db.take(Spec())
    backend = db.store._backend
    insert_steps = backend.insert_steps

    def cut(*arguments: Any) -> None:
        pid = arguments[0].execute(text("SELECT pg_backend_pid()")).scalar_one()
        execute(db.url, f"SELECT pg_terminate_backend({pid})")
        insert_steps(*arguments)

    backend.insert_steps = cut  # type: ignore[method-assign]
    with pytest.raises(StoreUnavailableError, match="server runs and answers") as caught:
        db.store.commit(claim, result(), RUN)
    assert caught.value.transient
    backend.insert_steps = insert_steps  # type: ignore[method-assign]
    assert db.store.commit(claim, result(), RUN)


def test_a_database_without_an_encoding_is_read_and_written(server: Engine) -> None:
    """As a server without a locale makes it."""
    name = f"test_{uuid.uuid4().hex}"
    engine = server.execution_options(isolation_level="AUTOCOMMIT")
    locale = "ENCODING 'SQL_ASCII' LC_COLLATE 'C' LC_CTYPE 'C'"
    with engine.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name} TEMPLATE template0 {locale}"))
    url = server.url.set(database=name).render_as_string(hide_password=False)
    run_all(url, Spec())
    with Reader.open(url) as reader:
        assert [row.status for row in reader.trials(Spec().config_key)] == ["done"]
    with engine.connect() as connection:
        connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))


def test_a_sleeper_that_sends_its_steps_is_ended(
    db: Database, open_store: Callable[..., Store], monkeypatch: pytest.MonkeyPatch
) -> None:
    late = open_store()
    launch, (sent, other) = begin(late, Spec(0), Spec(1))
    sends, wakes = threading.Event(), threading.Event()

    def asleep(column: Array) -> Iterator[float | None]:
        if not sends.is_set():
            sends.set()
            wakes.wait(PATIENCE_SECONDS)
        yield from column.tolist()

    monkeypatch.setattr("orchestrate.store.postgresql.finite_list", asleep)
    with ThreadPoolExecutor(1) as pool:
        committed = pool.submit(late.commit, sent, result(), RUN)
        assert sends.wait(PATIENCE_SECONDS)
        end_lease(db.url, launch)
        freed = db.store.recover()
        slept = not committed.done()
        wakes.set()
        with pytest.raises(StoreUnavailableError, match="the connection is lost"):
            committed.result(PATIENCE_SECONDS)
    assert slept, "others waited for the sleeper"
    while freed < 2:  # the server ends its session soon, not at once
        freed += db.store.recover()
    assert freed == 2
    assert not late.commit(sent, result(), RUN)
    assert not late.commit(other, result(1), RUN)
    assert db.rows("SELECT outcome FROM attempt") == [("lost",), ("lost",)]


def test_a_session_of_a_live_launch_is_left_alone(
    url: str, store: Store, open_store: Callable[..., Store]
) -> None:
    busy = open_store()
    launch = busy.begin_launch(LAUNCH)
    works, may_end = threading.Event(), threading.Event()

    def work() -> None:
        with busy._backend.transaction() as connection:
            connection.execute(text("SELECT 1"))
            works.set()
            may_end.wait(PATIENCE_SECONDS)
            connection.execute(text("SELECT 1"))

    with ThreadPoolExecutor(1) as pool:
        worked = pool.submit(work)
        assert works.wait(PATIENCE_SECONDS)
        for _ in range(5):
            end_lease(url, launch)
            busy.heartbeat(launch)
            assert store.recover() == 0
        may_end.set()
    assert worked.exception() is None


def test_the_server_asks_for_a_silent_launch(store: Store) -> None:
    with store._backend.transaction() as connection:
        for name in ("idle", "interval", "count"):
            asked = connection.execute(text(f"SHOW tcp_keepalives_{name}")).scalar_one()
            assert 0 < int(str(asked)) <= 5


PATIENCE = 0.6
LOCKED = "LOCK TABLE store_lock IN SHARE ROW EXCLUSIVE MODE"
ROW = "SELECT * FROM launch FOR UPDATE"


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Announce a wait after a fraction of the two seconds."""
    for module in (backend, sqlite, postgresql):
        monkeypatch.setattr(module, "ANNOUNCE_SECONDS", 0.2)
    monkeypatch.setattr(postgresql, "_WATCH_SECONDS", 0.05)


@contextmanager
def session(url: str, name: str = "meddler") -> Iterator[psycopg.Connection]:
    address = url.replace("+psycopg", "")
    with psycopg.connect(address, application_name=name) as connection:
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
        for statement in (
            f"CREATE ROLE {role}",
            f"GRANT USAGE ON SCHEMA {schema} TO {role}",
            f"GRANT SELECT ON ALL TABLES IN SCHEMA {schema} TO {role}",
            f"SET ROLE {role}",
        ):
            owner.execute(statement)  # type: ignore[arg-type]
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


def test_a_free_file_is_locked_at_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for patience in (0.05, 0.5):
        taken: list[float] = []
        locked = lambda seconds, taken=taken: not taken.append(seconds)  # noqa: E731
        sqlite.patiently(locked, patience, tmp_path, tmp_path)
        assert taken == [min(0.2, patience)]
    assert not warnings(caplog)


def test_nobody_listens() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
        with pytest.raises(StoreUnavailableError) as caught:
            Store.open(f"postgresql://me@127.0.0.1:{port}/db")
    assert caught.value.transient


def test_an_unknown_host_is_a_mistake_unless_it_has_answered_before() -> None:
    with pytest.raises(StoreUnavailableError) as caught:
        Store.open("postgresql://me@no-such-host.invalid/db")
    assert not caught.value.transient
    with pytest.raises(psycopg.OperationalError) as failed:
        psycopg.connect("host=no-such-host.invalid")
    assert is_transient(failed.value, known_host=True)


@pytest.mark.parametrize(
    ("wrong", "reason"), [("database", "does not exist"), ("username", "does not exist")]
)
def test_a_refused_login(postgresql_url: str, wrong: str, reason: str) -> None:
    url = make_url(postgresql_url).set(**{wrong: "nobody_knows"})  # type: ignore[arg-type]
    with pytest.raises(StoreUnavailableError, match=f"refuses the connection.*{reason}") as caught:
        Store.open(url.render_as_string(hide_password=False))
    assert not caught.value.transient


def test_a_read_only_server(store: Store) -> None:
    writing = store._backend.transaction()
    refused = pytest.raises(StoreUnavailableError, match="server is read-only")
    with refused as caught, writing as connection:
        connection.exec_driver_sql("SET TRANSACTION READ ONLY")
        connection.exec_driver_sql("DELETE FROM trial")
    assert not caught.value.transient


def test_which_errors_of_a_server_end_by_themselves() -> None:
    codes = {
        True: ("57P01", "57P03", "08006", "40P01", "53300"),
        False: ("53100", "28P01", "58030", "XX001", "57P04"),
    }
    words = {  # while a connection is made
        "FATAL:  the database system is starting up": True,
        "FATAL:  sorry, too many clients already": True,
        "server closed the connection unexpectedly": True,
        'FATAL:  password authentication failed for user "me"': False,
    }
    for expected, states in codes.items():
        for state in states:
            error = psycopg.errors.lookup(state)("the server's words")
            assert is_transient(error, known_host=False) is expected, state
    for said, expected in words.items():
        assert is_transient(psycopg.OperationalError(said), known_host=False) is expected, said


def test_the_error_travels_between_processes() -> None:
    for transient in (False, True):
        error = StoreUnavailableError("The database is gone.", transient=transient)
        assert pickle.loads(pickle.dumps(error)).transient is transient
