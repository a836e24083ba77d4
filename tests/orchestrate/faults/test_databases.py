"""Faults of the database: its disk, its file, its server."""

from __future__ import annotations

import random
import sqlite3
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.engine import make_url

from tests.orchestrate.faults.laboratory import Laboratory, Server
from tests.waiting import PATIENCE_SECONDS, until

At = Callable[..., Laboratory]

MEBIBYTE = 2**20
MEBIBYTES = 16
"""Size of the disk: room for the database and its log, without ballast."""

PAGE = 4096


class Disk:
    """A small disk in memory."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.mount("-t", "tmpfs", "-o", f"size={MEBIBYTES}m", "dopt-test")

    def mount(self, *words: str) -> None:
        subprocess.run(["mount", *words, str(self.folder)], check=True, capture_output=True)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    folder = tmp_path / "disk"
    folder.mkdir()
    try:
        made = Disk(folder)
    except (OSError, subprocess.SubprocessError) as error:
        pytest.skip(f"a file system is mounted by root only: {error}")
    yield made
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture
def on_disk(disk: Disk, laboratory_at: At) -> Laboratory:
    return laboratory_at(f"sqlite:///{disk.folder}/results.db", trials=120)


@pytest.fixture
def on_server(postgresql_url: str, laboratory_at: At) -> Laboratory:
    return laboratory_at(postgresql_url, trials=80)


def file_of(laboratory: Laboratory) -> Path:
    return Path(str(make_url(laboratory.url).database))


def test_a_full_disk_ends_the_launch_and_a_rerun_completes(on_disk: Laboratory, disk: Disk) -> None:
    ballast = disk.folder / "ballast"
    ballast.write_bytes(b"x" * (MEBIBYTES - 1) * MEBIBYTE)  # as another program would
    on_disk.run(75, "the disk is full", executor="inprocess", seconds=0.0)
    ballast.unlink()
    done = on_disk.count()
    assert 0 < done < on_disk.order.trials
    on_disk.check_whole()
    assert f"{done} of {on_disk.order.trials} already done" in on_disk.complete()


def test_a_disk_that_is_read_only_is_left_alone(on_disk: Laboratory, disk: Disk) -> None:
    on_disk.run(trials=10, executor="inprocess")
    disk.mount("-o", "remount,ro")
    on_disk.run(75, "Read-only file system")
    disk.mount("-o", "remount,rw")
    on_disk.complete()


def test_a_torn_log_costs_the_last_trials_only(sqlite_url: str, laboratory_at: At) -> None:
    laboratory = laboratory_at(sqlite_url)
    laboratory.gate.let(15)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 5)
        laboratory.gate.let(15)  # in transactions of their own, at the end of the log
        launched.until(lambda: laboratory.count() >= 20)
        launched.kill()
    path = file_of(laboratory)
    log = path.with_name(f"{path.name}-wal")
    before = laboratory.count()
    with log.open("r+b") as opened:
        opened.truncate(int(0.9 * log.stat().st_size))
    assert 0 < laboratory.count() < before
    laboratory.check_whole()
    laboratory.complete()


def test_a_damaged_file_ends_the_launch_and_stays_as_it_is(
    sqlite_url: str, laboratory_at: At
) -> None:
    laboratory = laboratory_at(sqlite_url)
    laboratory.complete()
    path = file_of(laboratory)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    damaged = bytearray(path.read_bytes())
    damaged[PAGE : 20 * PAGE] = b"\x5a" * (19 * PAGE)
    path.write_bytes(damaged)
    laboratory.run(75, "the file is damaged")
    assert path.read_bytes() == damaged


@pytest.mark.parametrize("seconds", [0.05, 3600.0])
@pytest.mark.parametrize("replaced", [False, True])
def test_a_removed_file_ends_the_launch_and_is_saved(
    sqlite_url: str, laboratory_at: At, replaced: bool, seconds: float, tmp_path: Path
) -> None:
    """A launch stops where trials end and where none does, and writes nothing to another file."""
    laboratory = laboratory_at(sqlite_url)
    path, other = file_of(laboratory), tmp_path / "other.db"
    laboratory.run(executor="inprocess", trials=10, seconds=0.0)
    before = laboratory.count()
    other.write_bytes(path.read_bytes())
    laboratory.gate.let(5)
    with laboratory.launched(seconds=seconds) as launched:
        launched.until(lambda: laboratory.count("status = 'running'") > 0)
        other.rename(path) if replaced else path.unlink()
        content = path.read_bytes() if replaced else b""
        laboratory.gate.open()
        saved = path.with_name(f"{path.name}.saved-{launched.pid}.db")
        launched.ends(75, f"what it held is saved in {saved}:")
    assert "waiting for" not in launched.errors
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
            launched.ends()
            again = connection.execute(text("SELECT count(*) FROM attempt")).scalar_one()
        engine.dispose()
    assert again == seen < laboratory.order.trials
    laboratory.check()


RESTARTS = pytest.mark.xdist_group("postgresql-restarts")


@RESTARTS
def test_connections_that_end_at_random_moments_cost_nothing(
    on_server: Laboratory, server: Server
) -> None:
    moments = random.Random(0)
    done = ended = 0
    on_server.gate.let(40)
    with on_server.launched() as launched:
        while launched.process.is_alive():
            until(lambda: on_server.count() > done or not launched.process.is_alive())  # noqa: B023
            done = on_server.count()
            time.sleep(moments.uniform(0.0, 0.3))
            ended += server.terminate_backends()
            if ended:
                on_server.gate.open()
        launched.ends()
    assert ended > 0
    on_server.check()


@RESTARTS
@pytest.mark.parametrize("mode", ["fast", "immediate"])
def test_a_restart_of_the_server_costs_nothing(
    on_server: Laboratory, server: Server, mode: str
) -> None:
    with on_server.launched(settings={"patience": PATIENCE_SECONDS}) as launched:
        for done in (5, 30):
            on_server.gate.let(25)
            launched.until(lambda done=done: on_server.count() >= done)  # type: ignore[misc]
            server.restart(mode)
        on_server.gate.open()
        launched.ends()
    on_server.check()
    assert on_server.count("status = 'running'") == 0


@RESTARTS
def test_a_server_that_stays_away_ends_the_launch_and_a_rerun_completes(
    on_server: Laboratory, server: Server
) -> None:
    on_server.gate.let(20)
    with on_server.launched(settings={"patience": 2}) as launched:
        launched.until(lambda: on_server.count() >= 5)
        server.stop()
        on_server.gate.open()  # all that had passed may be stored: then nothing asks the server
        try:
            launched.ends(75, "server runs and answers")
        finally:
            server.start()
    assert 5 <= on_server.count() < on_server.order.trials
    on_server.check_whole()
    on_server.end_lease(launched)
    on_server.complete()
