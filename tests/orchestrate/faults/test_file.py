"""The file of a SQLite database is torn, damaged or removed, or somebody reads it for very long."""

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


@pytest.mark.parametrize("seconds", [0.05, 3600.0])
@pytest.mark.parametrize("replaced", [False, True])
def test_a_removed_file_ends_the_launch_and_is_saved(
    file_laboratory: Laboratory, replaced: bool, seconds: float, tmp_path: Path
) -> None:
    """A launch stops where trials end and where none does, and writes nothing to another file."""
    laboratory, path = file_laboratory, file_of(file_laboratory)
    with laboratory.launched(executor="inprocess", trials=10, seconds=0.0) as launched:
        assert launched.end() == 0, launched.errors
    before, other = laboratory.count(), tmp_path / "other.db"
    other.write_bytes(path.read_bytes())
    with laboratory.launched(seconds=seconds) as launched:
        launched.until(lambda: laboratory.count("status = 'running'") > 0)
        other.rename(path) if replaced else path.unlink()
        content = path.read_bytes() if replaced else b""
        assert launched.end() == 75, launched.said + launched.errors
        pid = launched.pid
    assert launched.errors.count("error:") == 1
    assert "waiting for" not in launched.errors
    assert "Traceback" not in launched.errors
    saved = path.with_name(f"{path.name}.saved-{pid}.db")
    assert f"what it held is saved in {saved}:" in launched.errors
    assert path.read_bytes() == content if replaced else not path.exists()
    saved.replace(path)
    assert laboratory.count() >= before
    assert laboratory.count("status = 'running'") == 0
    laboratory.complete()


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
