"""A laboratory for each test, on each database; one PostgreSQL server of our own for all."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.orchestrate.faults.laboratory import Laboratory, Rows, Server, binaries, results
from tests.orchestrate.faults.program import Order

TRIALS = Order.trials


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    try:
        binaries()
    except FileNotFoundError as error:
        if os.environ.get("DOPT_REQUIRE_POSTGRES") == "1":
            pytest.fail(str(error))
        pytest.skip(str(error))
    server = Server()
    yield server
    server.remove()


@pytest.fixture
def postgresql_url(server: Server) -> str:
    return server.new_url()


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Rows]:
    """Return a function that gives what a grid leaves when nothing happens to it."""
    known: dict[int, Rows] = {}

    def rows(trials: int) -> Rows:
        if trials not in known:
            folder = tmp_path_factory.mktemp("undisturbed")
            url = f"sqlite:///{folder}/results.db"
            order = Order(url, executor="inprocess", trials=trials, seconds=0.0)
            Laboratory(folder, order, dict).run()
            known[trials] = results(url)
        return known[trials]

    return rows


@pytest.fixture
def laboratory_at(tmp_path: Path, undisturbed: Callable[[int], Rows]) -> Callable[..., Laboratory]:
    def build(url: str, trials: int = TRIALS, **order: Any) -> Laboratory:
        expected = partial(undisturbed, trials)
        return Laboratory(tmp_path, Order(url, trials=trials, **order), expected)

    return build


@pytest.fixture
def laboratory(url: str, laboratory_at: Callable[..., Laboratory]) -> Laboratory:
    return laboratory_at(url)
