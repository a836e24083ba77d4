"""The disk of a SQLite database is full, or can only be read."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.orchestrate.faults.laboratory import Laboratory

MEBIBYTE = 2**20
MEBIBYTES = 16
"""Size of the disk: room for the database and its log, without ballast."""


class Disk:
    """A small disk in memory."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.mount("-t", "tmpfs", "-o", f"size={MEBIBYTES}m", "dopt-test")

    def mount(self, *words: str) -> None:
        subprocess.run(["mount", *words, str(self.folder)], check=True, capture_output=True)

    def fill(self, left: int) -> None:
        """Leave about that many bytes free, as another program would."""
        (self.folder / "ballast").write_bytes(b"x" * (MEBIBYTES * MEBIBYTE - left))

    def make_room(self) -> None:
        (self.folder / "ballast").unlink()


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
def laboratory(disk: Disk, laboratory_at: Callable[..., Laboratory]) -> Laboratory:
    return laboratory_at(f"sqlite:///{disk.folder}/results.db", trials=120)


def test_a_full_disk_ends_the_launch_and_a_rerun_completes(
    laboratory: Laboratory, disk: Disk
) -> None:
    disk.fill(left=MEBIBYTE)
    with laboratory.launched(seconds=0.01) as launched:
        assert launched.end() == 75, launched.said + launched.errors
    assert "the disk is full" in launched.errors
    assert launched.errors.count("error:") == 1
    assert "Traceback" not in launched.errors
    disk.make_room()
    done = laboratory.count()
    assert 0 < done < laboratory.order.trials
    laboratory.check_whole()
    said = laboratory.complete(seconds=0.01)
    assert f"{done} of {laboratory.order.trials} already done" in said


def test_a_disk_that_is_read_only_is_left_alone(laboratory: Laboratory, disk: Disk) -> None:
    with laboratory.launched(trials=10) as launched:
        assert launched.end() == 0, launched.errors
    disk.mount("-o", "remount,ro")
    with laboratory.launched() as launched:
        assert launched.end() == 75, launched.said + launched.errors
    assert launched.errors.count("error:") == 1
    assert "Read-only file system" in launched.errors
    assert "Traceback" not in launched.errors
    disk.mount("-o", "remount,rw")
    laboratory.complete()
