"""The file of a SQLite database is torn or damaged, or somebody reads it for very long."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.engine import make_url

from tests.orchestrate.faults.laboratory import Laboratory

PAGE = 4096


@pytest.fixture
def file_laboratory(sqlite_url: str, laboratory_at: Callable[..., Laboratory]) -> Laboratory:
    return laboratory_at(sqlite_url)


def file_of(laboratory: Laboratory) -> Path:
    return Path(str(make_url(laboratory.url).database))


def test_a_torn_log_costs_the_last_trials_only(file_laboratory: Laboratory) -> None:
    laboratory = file_laboratory
    laboratory.gate.let(25)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 15)
        launched.kill()
    path = file_of(laboratory)
    log = path.with_name(f"{path.name}-wal")
    before = laboratory.count()
    with log.open("r+b") as opened:
        opened.truncate(int(0.9 * log.stat().st_size))
    assert 0 < laboratory.count() < before
    laboratory.check_whole()
    laboratory.complete()


def test_a_damaged_file_ends_the_launch_and_stays_as_it_is(file_laboratory: Laboratory) -> None:
    laboratory = file_laboratory
    laboratory.complete(executor="inprocess")
    path = file_of(laboratory)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    damaged = bytearray(path.read_bytes())
    damaged[PAGE : 20 * PAGE] = b"\x5a" * (19 * PAGE)
    path.write_bytes(damaged)
    with laboratory.launched() as launched:
        assert launched.end() == 75, launched.said + launched.errors
    assert "the file is damaged" in launched.errors
    assert launched.errors.count("error:") == 1
    assert "Traceback" not in launched.errors
    assert path.read_bytes() == damaged


def test_a_reader_that_never_ends_holds_up_nobody(laboratory: Laboratory) -> None:
    laboratory.gate.let(10)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 5)
        engine = create_engine(laboratory.url, isolation_level="SERIALIZABLE")
        with engine.connect() as connection:
            connection.execute(text("BEGIN")) if engine.name == "sqlite" else None
            seen = connection.execute(text("SELECT count(*) FROM attempt")).scalar_one()
            laboratory.gate.open()
            assert launched.end() == 0, launched.errors
            again = connection.execute(text("SELECT count(*) FROM attempt")).scalar_one()
        engine.dispose()
    assert again == seen < laboratory.order.trials
    laboratory.check()
