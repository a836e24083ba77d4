"""Faults while a launch registers itself and its grid: it goes on, and registers nothing twice."""

from __future__ import annotations

import signal
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import psycopg
import pytest
from sqlalchemy.engine import make_url

from orchestrate.config import LaunchSettings
from orchestrate.errors import ExitCode
from orchestrate.runner.saving import RetryingStore
from orchestrate.runner.start import Output, recorded_launch
from orchestrate.store import Reader
from tests.orchestrate.conftest import RECORD
from tests.orchestrate.faults.laboratory import Laboratory, Launched, Server, stands_still
from tests.orchestrate.faults.trials import grid_of
from tests.waiting import PATIENCE_SECONDS

At = Callable[..., Laboratory]

COMMIT = "COMMIT"
TRIALS = 3
SHORT = {"lease": 2.0, "patience": PATIENCE_SECONDS}


@dataclass
class Messages:
    """Messages of this thread to a server, of which the n-th ends the session.

    Attributes
    ----------
    sent
        The messages so far.
    fatal
        Number of the message whose session ends before it is carried out; None for no message.
    lost
        Whether it is carried out first and its answer is lost: only a commit's answer matters.
    """

    server: Server
    fatal: int | None = None
    lost: bool = False
    sent: list[str] = field(default_factory=list)
    thread: int = field(default_factory=threading.get_ident)

    def send(self, connection: psycopg.Connection, what: str, message: Callable[[], Any]) -> Any:
        if threading.get_ident() != self.thread:
            return message()
        self.sent.append(what)
        if len(self.sent) - 1 != self.fatal:
            return message()
        self.fatal, pid = None, connection.info.backend_pid
        if self.lost:
            message()
        self.server.query(f"SELECT pg_terminate_backend({pid}, 60000)")
        if self.lost:
            raise psycopg.OperationalError("server closed the connection unexpectedly")
        return message()


@pytest.fixture
def messages(server: Server, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Messages]:
    """Return a function that counts the messages from now on."""
    found = [Messages(server)]

    def counted(name: str) -> Callable[..., Any]:
        send = getattr(psycopg.Cursor, name)

        def sent(cursor: psycopg.Cursor, query: Any, *given: Any, **options: Any) -> Any:
            message = partial(send, cursor, query, *given, **options)
            return found[-1].send(cursor.connection, str(query), message)

        return sent

    def committed(connection: psycopg.Connection) -> None:
        found[-1].send(connection, COMMIT, partial(commit, connection))

    def begin(**options: Any) -> Messages:
        found.append(Messages(server, **options))
        return found[-1]

    commit = psycopg.Connection.commit
    for name in ("execute", "executemany"):
        monkeypatch.setattr(psycopg.Cursor, name, counted(name))
    monkeypatch.setattr(psycopg.Connection, "commit", committed)
    monkeypatch.setattr("orchestrate.runner.saving.FIRST_PAUSE_SECONDS", 0.001)
    return begin


def registered(url: str) -> list[str]:
    """Register a launch, its grid and its claims, as every launch does; return what it said."""

    def body(store: RetryingStore) -> ExitCode:
        store.recover()
        todo = store.register(grid_of(TRIALS).trials).todo
        assert len(store.claim(todo)) == TRIALS
        return ExitCode.DONE

    said: list[str] = []
    settings = LaunchSettings("inprocess", url, lease=60.0, patience=PATIENCE_SECONDS)
    assert recorded_launch(settings, RECORD, Output(said.append, said.append), body) == 0
    return said


def check(url: str, launches: int) -> None:
    """See that everything is there once, and that nothing was left open."""
    with Reader.open(url) as reader:
        states = reader.rows("SELECT state, exit_code, ended IS NULL FROM launch")
        assert [tuple(row) for row in states] == [("done", 0, False)] * launches
        trials = reader.rows("SELECT seed, status, owner FROM trial ORDER BY seed")
        assert [tuple(row) for row in trials] == [(n, "pending", None) for n in range(TRIALS)]
        for sql in (
            "SELECT count(*) FROM alembic_version",
            "SELECT count(*) FROM config",
            "SELECT 1 + count(*) FROM attempt WHERE outcome IS NULL OR ended IS NULL",
        ):
            assert [tuple(row) for row in reader.rows(sql)] == [(1,)], sql


@pytest.mark.parametrize("exists", [False, True], ids=["new", "existing"])
def test_a_session_that_ends_at_any_message_costs_one_repetition(
    server: Server, messages: Callable[..., Messages], exists: bool
) -> None:
    """Of a new database those that make its tables, as the others are the same."""

    def prepared() -> str:
        url = server.new_url()
        if exists:
            registered(url)
        return url

    url = prepared()
    undisturbed = messages()
    assert registered(url) == []
    expected = list(undisturbed.sent)
    check(url, 1 + exists)
    assert any("CREATE TABLE launch" in one for one in expected) is not exists
    begins = next(n for n, one in enumerate(expected) if "INSERT INTO launch" in one)
    wanted = range(len(expected) if exists else begins)
    commits = [n for n in wanted if expected[n] == COMMIT]
    assert len(commits) >= (6 if exists else 2)
    for n, lost in [*((n, False) for n in wanted), *((n, True) for n in commits)]:
        url = prepared()
        cut = messages(fatal=n, lost=lost)
        said = registered(url)
        assert cut.fatal is None, "no session was ended"
        assert len(said) in (0, 2), (expected[n], said)
        check(url, 1 + exists)


@contextmanager
def asleep(laboratory: Laboratory, statement: str) -> Iterator[Launched]:
    """Yield a launch that stopped itself before a statement; woken, it ends well as one of two."""
    with laboratory.launched(stop=statement) as sleeper:
        sleeper.until(lambda: stands_still(sleeper.pid))
        yield sleeper
        sleeper.ends()
    laboratory.check()
    assert laboratory.query("SELECT state, count(*) FROM launch GROUP BY 1") == [("done", 2)]


STATEMENTS = ("CREATE TABLE launch", "INSERT INTO launch", "LOCK", "INSERT INTO trial", "UPDATE tr")


@pytest.mark.parametrize("statement", STATEMENTS)
def test_a_launch_that_sleeps_past_its_lease_while_it_registers_goes_on(
    postgresql_url: str, laboratory_at: At, statement: str
) -> None:
    laboratory = laboratory_at(postgresql_url, trials=5, executor="inprocess", settings=SHORT)
    with asleep(laboratory, statement) as sleeper:
        laboratory.complete()
        sleeper.send(signal.SIGCONT)


def file_of(laboratory: Laboratory) -> Path:
    return Path(str(make_url(laboratory.url).database))


@pytest.mark.parametrize("statement", ["CREATE TABLE launch", "INSERT INTO launch"])
def test_others_wait_for_a_sleeper_that_registers_in_a_file(
    sqlite_url: str, laboratory_at: At, statement: str
) -> None:
    laboratory = laboratory_at(sqlite_url, trials=5, executor="inprocess", settings=SHORT)
    with asleep(laboratory, statement) as sleeper, laboratory.launched() as other:
        other.until(lambda: "waiting for a lock" in other.errors)
        sleeper.send(signal.SIGCONT)
        other.ends()


@pytest.mark.parametrize("exists", [False, True], ids=["new", "existing"])
def test_a_file_that_another_program_has_locked_is_waited_for(
    sqlite_url: str, laboratory_at: At, exists: bool
) -> None:
    laboratory = laboratory_at(sqlite_url, trials=5, executor="inprocess", settings=SHORT)
    if exists:
        laboratory.run(trials=2)
    path = file_of(laboratory)
    path.parent.mkdir(exist_ok=True)
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with laboratory.launched() as launched:
            launched.until(lambda: f"lock of {path}" in launched.errors)
            other.execute("ROLLBACK")
            launched.ends()
    laboratory.check()


@pytest.mark.xdist_group("postgresql-restarts")
@pytest.mark.parametrize("worker", [None, {}], ids=["launch", "worker"])
def test_a_server_that_starts_later_is_waited_for(
    postgresql_url: str, server: Server, laboratory_at: At, worker: dict[str, Any] | None
) -> None:
    laboratory = laboratory_at(postgresql_url, trials=5, executor="inprocess", settings=SHORT)
    laboratory.run(settings={"detach": True})
    with ExitStack() as later:
        server.stop()
        later.callback(server.start)
        with laboratory.launched(worker=worker) as launched:
            launched.until(lambda: "waiting for up to" in launched.said)
            later.close()
            launched.ends()
    laboratory.check()
