"""What only a server can do: leases on its clock, connections that it ends."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from sqlalchemy import create_engine, text

from orchestrate.store import Claim, Reader, Store, StoreUnavailableError
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, result

LEASE_SECONDS = 0.5


@pytest.fixture
def url(postgresql_url: str) -> str:
    return postgresql_url


@pytest.fixture
def sleeper(open_store: Callable[..., Store]) -> tuple[Store, int, Claim]:
    """Return a launch that claimed a trial and shows no life since, as after SIGSTOP."""
    store = open_store(LEASE_SECONDS)
    launch = store.begin_launch(LAUNCH)
    (claim,) = store.claim(launch, store.register(launch, [Spec()]).todo)
    time.sleep(LEASE_SECONDS * 1.2)
    return store, launch, claim


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
