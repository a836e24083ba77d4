"""A grid in each kind of database, made once, and a client of the application over it."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from sqlalchemy import text
from starlette.testclient import TestClient

from analysis.serve.app import create_app
from orchestrate.store import Reader
from tests.analysis.browser import grids
from tests.conftest import SERVER

BASE = "http://127.0.0.1:8000"


@pytest.fixture(scope="session")
def sqlite_grid(tmp_path_factory: pytest.TempPathFactory) -> str:
    url = f"sqlite:///{tmp_path_factory.mktemp('mixed')}/results.db"
    grids.mixed(url)
    return url


@pytest.fixture(scope="session")
def postgresql_grid(request: pytest.FixtureRequest) -> Iterator[str]:
    server = request.getfixturevalue("server")
    schema = f"test_{uuid.uuid4().hex}"
    with server.begin() as connection:
        connection.execute(text(f"CREATE SCHEMA {schema}"))
    url = f"{SERVER}?options=-csearch_path%3D{schema}"
    grids.mixed(url)
    yield url
    with server.begin() as connection:
        connection.execute(text(f"DROP SCHEMA {schema} CASCADE"))


@pytest.fixture(params=["sqlite", "postgresql"])
def grid(request: pytest.FixtureRequest) -> str:
    """Return the URL of the mixed grid in a database of each kind."""
    return str(request.getfixturevalue(f"{request.param}_grid"))


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest) -> str:
    """Return the URL of no database yet, of each kind."""
    return str(request.getfixturevalue(f"{request.param}_url"))


@pytest.fixture
def reader(grid: str) -> Iterator[Reader]:
    with Reader.open(grid) as opened:
        yield opened


@pytest.fixture
def visit(tmp_path: Path) -> Iterator[Callable[..., TestClient]]:
    """Return a function that gives a client of the application over a database."""
    with ExitStack() as stack:

        def open_client(url: str, figures: Path = tmp_path / "figures") -> TestClient:
            client = TestClient(create_app(url, figures), base_url=BASE)
            return stack.enter_context(client)

        yield open_client


@pytest.fixture
def client(grid: str, visit: Callable[..., TestClient]) -> TestClient:
    return visit(grid)
