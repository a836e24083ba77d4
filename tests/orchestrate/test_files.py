"""Files that appear whole or not at all."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from dopt.errors import DoptError
from orchestrate.files import OutputError, make_folder, whole, whole_folder, writing


def full() -> OSError:
    return OSError(errno.ENOSPC, "No space left on device")


def test_a_torn_file_is_removed_and_the_cause_named(tmp_path: Path) -> None:
    target = tmp_path / "new" / "table.csv"
    with pytest.raises(OutputError, match=r"table.csv cannot be written \(No space left on device"):  # noqa: SIM117, PT012
        with whole(target) as part:
            part.write_text("half")
            raise full()
    assert list(target.parent.iterdir()) == []
    with whole(target) as part:
        part.write_text("all")
    assert [path.name for path in target.parent.iterdir()] == ["table.csv"]


def test_a_folder_is_whole_too(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No space left"), whole_folder(tmp_path / "x", bool):
        raise full()
    assert list(tmp_path.iterdir()) == []


def test_an_error_of_a_library_that_a_full_disk_caused_is_recognised(tmp_path: Path) -> None:
    """Matplotlib closes a PDF that it could not begin, and fails once more."""
    with pytest.raises(OutputError, match="No space left"), writing(tmp_path):  # noqa: PT012
        try:
            raise full()
        finally:
            raise AttributeError("'Stream' object has no attribute 'pos'")
    with pytest.raises(OutputError, match="No space left on device"), writing(tmp_path):
        raise RuntimeError("(sqlite3.OperationalError) database or disk is full")


@pytest.mark.parametrize("error", [ValueError("no"), DoptError("the disk is full")])
def test_other_errors_stay_as_they_are(error: Exception, tmp_path: Path) -> None:
    with pytest.raises(type(error), match=str(error)), writing(tmp_path):
        raise error


def test_devices_are_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(OutputError, match="it is no file"), whole(pipe) as part:
        part.write_text("all")
    assert pipe.is_fifo()


def test_a_folder_below_a_file_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"file/x cannot be written \(Not a directory\)"):
        make_folder(tmp_path / "file" / "x")
