"""One database for each test, of each kind that the contract names."""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import Engine, create_engine, text
from sqlalchemy.exc import OperationalError

from orchestrate.store import Claim, Reader, Store
from tests.orchestrate.store.fakes import LAUNCH, Spec

SERVER = os.environ.get(
    "DOPT_TEST_POSTGRES", "postgresql+psycopg://postgres@127.0.0.1:5432/postgres"
)


@pytest.fixture
def sqlite_url(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path}/results/results.db"


@pytest.fixture(scope="session")
def server() -> Iterator[Engine]:
    engine = create_engine(SERVER, connect_args={"connect_timeout": 3})
    try:
        engine.connect().close()
    except OperationalError as error:
        _no_server(str(error.orig).splitlines()[0])
    yield engine
    engine.dispose()


@pytest.fixture
def postgresql_url(server: Engine) -> Iterator[str]:
    """URL of a new schema on a running server, dropped afterwards."""
    schema = f"test_{uuid.uuid4().hex}"
    with server.begin() as connection:
        connection.execute(text(f"CREATE SCHEMA {schema}"))
    yield f"{SERVER}?options=-csearch_path%3D{schema}"
    with server.begin() as connection:
        connection.execute(text(f"DROP SCHEMA {schema} CASCADE"))


def _no_server(reason: str) -> None:
    message = f"no PostgreSQL server answers, set DOPT_TEST_POSTGRES to one: {reason}"
    if os.environ.get("DOPT_REQUIRE_POSTGRES") == "1":
        pytest.fail(message)
    pytest.skip(message)


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest) -> str:
    return str(request.getfixturevalue(f"{request.param}_url"))


@pytest.fixture
def open_store(url: str) -> Iterator[Callable[..., Store]]:
    """Open any number of stores on the one database, as so many processes would."""
    stores = []

    def open_one(lease_seconds: float = 60.0) -> Store:
        stores.append(Store.open(url, lease_seconds=lease_seconds))
        return stores[-1]

    yield open_one
    for store in stores:
        store.close()


@pytest.fixture
def store(open_store: Callable[..., Store]) -> Store:
    return open_store()


@pytest.fixture
def launch(store: Store) -> int:
    return store.begin_launch(LAUNCH)


@pytest.fixture
def reader(url: str, store: Store) -> Iterator[Reader]:  # noqa: ARG001 the store creates it
    with Reader.open(url) as opened:
        yield opened


@pytest.fixture
def take(store: Store, launch: int) -> Callable[..., list[Claim]]:
    """Register and claim the given trials."""

    def register_and_claim(*specs: Spec) -> list[Claim]:
        return store.claim(launch, store.register(launch, specs).todo)

    return register_and_claim
