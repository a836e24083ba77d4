"""A grid in each kind of database, made once, and a client of the application over it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
from playwright.sync_api import Browser, Page
from starlette.testclient import TestClient

from analysis.serve.app import create_app
from orchestrate.store import Reader
from tests.analysis.browser import chromium, grids
from tests.orchestrate.store.databases import new_schema

BASE = "http://127.0.0.1:8000"


@pytest.fixture(scope="session")
def sqlite_grid(tmp_path_factory: pytest.TempPathFactory) -> str:
    url = f"sqlite:///{tmp_path_factory.mktemp('mixed')}/results.db"
    grids.mixed(url)
    return url


@pytest.fixture(scope="session")
def variants_grid(tmp_path_factory: pytest.TempPathFactory) -> str:
    url = f"sqlite:///{tmp_path_factory.mktemp('variants')}/results.db"
    grids.variants(url)
    return url


@pytest.fixture(scope="session")
def postgresql_grid(request: pytest.FixtureRequest) -> Iterator[str]:
    with new_schema(request) as url:
        grids.mixed(url)
        yield url


@pytest.fixture(params=["sqlite", "postgresql"])
def grid(request: pytest.FixtureRequest) -> str:
    """Return the URL of the mixed grid in a database of each kind."""
    return str(request.getfixturevalue(f"{request.param}_grid"))


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest) -> str:
    """Return the URL of no database yet, of each kind."""
    return str(request.getfixturevalue(f"{request.param}_url"))


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Return one Chromium for all tests of this folder."""
    with chromium.opened() as opened:
        yield opened


@pytest.fixture(scope="package")
def address(sqlite_grid: str) -> Iterator[str]:
    """Return the address of a server of the mixed grid."""
    with chromium.served(sqlite_grid) as found:
        yield found


@pytest.fixture(scope="package")
def variants(variants_grid: str) -> Iterator[str]:
    """Return the address of a server of the grid of variants."""
    with chromium.served(variants_grid) as found:
        yield found


@pytest.fixture
def page(browser: Browser, address: str) -> Iterator[Page]:
    with chromium.strict_page(browser, address) as opened:
        yield opened


@pytest.fixture
def reader(grid: str) -> Iterator[Reader]:
    with Reader.open(grid) as opened:
        yield opened


@pytest.fixture
def visit() -> Iterator[Callable[..., TestClient]]:
    """Return a function that gives a client of the application over a database."""
    with ExitStack() as stack:

        def open_client(url: str) -> TestClient:
            client = TestClient(create_app(url), base_url=BASE)
            return stack.enter_context(client)

        yield open_client


@pytest.fixture
def client(grid: str, visit: Callable[..., TestClient]) -> TestClient:
    return visit(grid)
