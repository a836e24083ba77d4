"""Errors that say that waiting may help."""

from __future__ import annotations

import pickle
import socket
import sqlite3
from pathlib import Path

import pytest
from sqlalchemy.engine import make_url

from orchestrate.store import Store, StoreUnavailableError
from orchestrate.store.backends.transient_errors import is_transient
from tests.orchestrate.store.fakes import LAUNCH

psycopg = pytest.importorskip("psycopg")


def _transient(url: str) -> bool:
    with pytest.raises(StoreUnavailableError) as caught:
        Store.open(url)
    return caught.value.transient


def test_nobody_listens() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
        assert _transient(f"postgresql://me@127.0.0.1:{port}/db")


def test_an_unknown_host_is_a_mistake_unless_it_has_answered_before() -> None:
    assert not _transient("postgresql://me@no-such-host.invalid/db")
    with pytest.raises(psycopg.OperationalError) as caught:
        psycopg.connect("host=no-such-host.invalid")
    assert is_transient(caught.value, known_host=True)


@pytest.mark.parametrize(
    ("wrong", "reason"), [("database", "does not exist"), ("username", "does not exist")]
)
def test_a_refused_login(postgresql_url: str, wrong: str, reason: str) -> None:
    url = make_url(postgresql_url).set(**{wrong: "nobody_knows"})  # type: ignore[arg-type]
    with pytest.raises(StoreUnavailableError, match=f"refuses the connection.*{reason}") as caught:
        Store.open(url.render_as_string(hide_password=False))
    assert not caught.value.transient


def _end_own_backend(store: Store, other: Store) -> None:
    with store._backend.transaction() as connection:
        pid = connection.exec_driver_sql("SELECT pg_backend_pid()").scalar_one()
        with other._backend.transaction() as ends:
            ends.exec_driver_sql(f"SELECT pg_terminate_backend({pid})")
        connection.exec_driver_sql("SELECT 1")


def test_a_connection_that_an_administrator_ended(postgresql_url: str) -> None:
    with Store.open(postgresql_url) as store, Store.open(postgresql_url) as other:
        with pytest.raises(StoreUnavailableError) as caught:
            _end_own_backend(store, other)
        assert caught.value.transient
        assert store.begin_launch(LAUNCH) == 1


def _write_read_only(store: Store) -> None:
    with store._backend.transaction() as connection:
        connection.exec_driver_sql("SET TRANSACTION READ ONLY")
        connection.exec_driver_sql("DELETE FROM trial")


def test_a_read_only_server(postgresql_url: str) -> None:
    with Store.open(postgresql_url) as store:
        with pytest.raises(StoreUnavailableError, match="server is read-only") as caught:
            _write_read_only(store)
        assert not caught.value.transient


@pytest.mark.parametrize(
    ("state", "expected"),
    [("57P01", True), ("57P03", True), ("08006", True), ("40P01", True), ("53300", True),
     ("53100", False), ("28P01", False), ("58030", False), ("XX001", False), ("57P04", False)],
)  # fmt: skip
def test_codes_of_the_server(state: str, expected: bool) -> None:
    error = psycopg.errors.lookup(state)("the server's words")
    assert is_transient(error, known_host=False) is expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("FATAL:  the database system is starting up", True),
        ("FATAL:  sorry, too many clients already", True),
        ("server closed the connection unexpectedly", True),
        ('FATAL:  password authentication failed for user "me"', False),
    ],
)
def test_words_of_the_server_while_a_connection_is_made(text: str, expected: bool) -> None:
    assert is_transient(psycopg.OperationalError(text), known_host=False) is expected


def test_a_lock_that_another_process_holds(tmp_path: Path) -> None:
    path = tmp_path / "results.db"
    with Store.open(f"sqlite:///{path}", patience=0.1) as store:
        other = sqlite3.connect(path, isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreUnavailableError, match="locked") as caught:
            store.begin_launch(LAUNCH)
        other.close()
        assert not caught.value.transient, "it was waited for with all patience"
        assert store.begin_launch(LAUNCH) == 1


def test_a_file_that_is_no_database(tmp_path: Path) -> None:
    path = tmp_path / "results.db"
    path.write_text("Some notes, long enough to be taken for a header of a database. " * 4)
    assert not _transient(f"sqlite:///{path}")


@pytest.mark.parametrize("transient", [False, True])
def test_the_error_travels_between_processes(transient: bool) -> None:
    error = StoreUnavailableError("The database is gone.", transient=transient)
    assert pickle.loads(pickle.dumps(error)).transient is transient
