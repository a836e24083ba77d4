"""One database for each test, of each kind that the contract names."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from orchestrate.store import Claim, Reader, Store
from orchestrate.store.records import Curves
from tests.orchestrate.store.databases import new_schema
from tests.orchestrate.store.fakes import LAUNCH, Spec
from tests.orchestrate.store.released import VERSIONS, restore


@pytest.fixture
def another_postgresql_url(request: pytest.FixtureRequest) -> Iterator[str]:
    """URL of one more new schema."""
    with new_schema(request) as url:
        yield url


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


@dataclass(frozen=True)
class Database:
    """One database, a store that writes to it, and a launch that has begun there."""

    url: str
    store: Store
    launch: int
    _request: pytest.FixtureRequest

    @property
    def reader(self) -> Reader:
        """Reader, which is opened when it is first asked for."""
        reader: Reader = self._request.getfixturevalue("reader")
        return reader

    def take(self, *specs: Spec) -> list[Claim]:
        """Register and claim the given trials."""
        return self.store.claim(self.launch, self.store.register(self.launch, specs).todo)

    def rows(self, sql: str) -> list[tuple[Any, ...]]:
        return [tuple(row) for row in self.reader.rows(sql)]

    def curves(self, value: str = "loss") -> Curves:
        """Return the curves of the usual configuration."""
        return self.reader.curves(Spec().config_key, value)


@pytest.fixture
def db(request: pytest.FixtureRequest, url: str, store: Store, launch: int) -> Database:
    return Database(url, store, launch, request)


each_version = pytest.mark.parametrize("version", VERSIONS, indirect=True)


@pytest.fixture
def version(request: pytest.FixtureRequest) -> int:
    """Return the schema of an older database: the oldest, whose upgrade takes every step."""
    return int(getattr(request, "param", VERSIONS[0]))


@pytest.fixture
def old(version: int, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """URL of a database of a released schema; the current folder takes backups of a server."""
    monkeypatch.chdir(tmp_path)
    restore(version, url)
    return url


each_other = pytest.mark.parametrize("other", ["sqlite", "postgresql"], indirect=True)


@pytest.fixture
def other(request: pytest.FixtureRequest, url: str, tmp_path: Path) -> str:
    """URL of another database, of the other kind, or with ``each_other`` of each kind."""
    first = "sqlite" if url.startswith("sqlite") else "postgresql"
    kind = getattr(request, "param", "postgresql" if first == "sqlite" else "sqlite")
    if kind == "sqlite":
        return f"sqlite:///{tmp_path}/other/results.db"
    name = "another_postgresql_url" if first == kind else "postgresql_url"
    return str(request.getfixturevalue(name))
