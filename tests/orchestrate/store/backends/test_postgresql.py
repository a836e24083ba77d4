"""Behaviour of a server alone: leases on its clock, connections that it ends."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import Engine, create_engine, text

from orchestrate.store import Claim, Reader, Store, StoreUnavailableError
from orchestrate.store.records import Array
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, result
from tests.orchestrate.store.places import execute
from tests.waiting import PATIENCE_SECONDS, until


@pytest.fixture
def url(postgresql_url: str) -> str:
    return postgresql_url


@pytest.fixture
def sleeper(url: str, open_store: Callable[..., Store]) -> tuple[Store, int, Claim]:
    """Return a launch that claimed a trial and shows no life since, as after SIGSTOP."""
    store = open_store()
    launch = store.begin_launch(LAUNCH)
    (claim,) = store.claim(launch, store.register(launch, [Spec()]).todo)
    end_lease(url, launch)
    return store, launch, claim


def end_lease(url: str, launch: int) -> None:
    """Let the lease of a launch run out, as time does."""
    execute(url, f"UPDATE launch SET lease_until = 0 WHERE launch_id = {launch}")


def test_a_lease_runs_out_by_itself(store: Store, open_store: Callable[..., Store]) -> None:
    late = open_store(3.0)
    launch = late.begin_launch(LAUNCH)
    assert len(late.claim(launch, late.register(launch, [Spec()]).todo)) == 1
    until(store.recover)


def test_claims_are_free_after_the_lease(
    store: Store, sleeper: tuple[Store, int, Claim], reader: Reader
) -> None:
    late, launch, claim = sleeper
    assert store.recover() == 1
    assert not late.commit(claim, result(), RUN)
    assert reader.query("SELECT state FROM launch")[0].state == "lost"
    late.heartbeat(launch)
    assert reader.query("SELECT state, ended FROM launch")[0].state == "running"


def test_a_heartbeat_renews_the_lease(store: Store, sleeper: tuple[Store, int, Claim]) -> None:
    late, launch, claim = sleeper
    late.heartbeat(launch)
    assert store.recover() == 0
    assert late.commit(claim, result(), RUN)


def test_a_claim_renews_the_lease(store: Store, sleeper: tuple[Store, int, Claim]) -> None:
    late, launch, claim = sleeper
    assert late.claim(launch, []) == []
    assert store.recover() == 0
    assert late.commit(claim, result(), RUN)


def test_an_ended_connection_costs_one_error(
    store: Store, launch: int, url: str, take: Callable[..., list[Claim]]
) -> None:
    (claim,) = take(Spec())
    insert_steps = store._backend.insert_steps

    def cut(*arguments: object) -> None:
        connection = arguments[0]
        pid = connection.execute(text("SELECT pg_backend_pid()")).scalar_one()  # type: ignore[attr-defined]
        _end_backend(url, pid)
        insert_steps(*arguments)  # type: ignore[arg-type]

    store._backend.insert_steps = cut  # type: ignore[method-assign]
    with pytest.raises(StoreUnavailableError, match="server runs and answers"):
        store.commit(claim, result(), RUN)
    store._backend.insert_steps = insert_steps  # type: ignore[method-assign]
    assert store.commit(claim, result(), RUN)
    store.end_launch(launch, "done")


def _end_backend(url: str, pid: int) -> None:
    engine = create_engine(url)
    with engine.begin() as connection:
        connection.execute(text("SELECT pg_terminate_backend(:pid)"), {"pid": pid})
    engine.dispose()


@pytest.fixture
def without_encoding(server: Engine) -> Iterator[str]:
    """Return the URL of a new database as a server without a locale makes it."""
    name = f"test_{uuid.uuid4().hex}"
    engine = server.execution_options(isolation_level="AUTOCOMMIT")
    locale = "ENCODING 'SQL_ASCII' LC_COLLATE 'C' LC_CTYPE 'C'"
    with engine.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name} TEMPLATE template0 {locale}"))
    yield server.url.set(database=name).render_as_string(hide_password=False)
    with engine.connect() as connection:
        connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))


def test_a_database_without_an_encoding_is_read_and_written(without_encoding: str) -> None:
    with Store.open(without_encoding) as store:
        launch = store.begin_launch(LAUNCH)
        (claim,) = store.claim(launch, store.register(launch, [Spec()]).todo)
        assert store.commit(claim, result(), RUN)
    with Reader.open(without_encoding) as reader:
        assert [row.status for row in reader.trials(Spec().config_key)] == ["done"]


def test_a_sleeper_that_sends_its_steps_is_ended(
    url: str,
    store: Store,
    open_store: Callable[..., Store],
    reader: Reader,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    late = open_store()
    launch = late.begin_launch(LAUNCH)
    sent, other = late.claim(launch, late.register(launch, [Spec(0), Spec(1)]).todo)
    sends, wakes = threading.Event(), threading.Event()

    def asleep(column: Array) -> Iterator[float | None]:
        if not sends.is_set():
            sends.set()
            wakes.wait(PATIENCE_SECONDS)
        yield from column.tolist()

    monkeypatch.setattr("orchestrate.store.backends.postgresql.finite_list", asleep)
    with ThreadPoolExecutor(1) as pool:
        committed = pool.submit(late.commit, sent, result(), RUN)
        assert sends.wait(PATIENCE_SECONDS)
        end_lease(url, launch)
        freed = store.recover()
        slept = not committed.done()
        wakes.set()
        with pytest.raises(StoreUnavailableError, match="the connection is lost"):
            committed.result(PATIENCE_SECONDS)
    assert slept, "others waited for the sleeper"
    while freed < 2:  # the server ends its session soon, not at once
        freed += store.recover()
    assert freed == 2
    assert not late.commit(sent, result(), RUN)
    assert not late.commit(other, result(1), RUN)
    rows = reader.query("SELECT outcome FROM attempt")
    assert [tuple(row) for row in rows] == [("lost",), ("lost",)]


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
