"""Copies of local databases in a folder that machines share, and their merge.

A copy is made on the local disk and gets its name in the folder when it is complete: no database is
ever opened there, so that the locks of the folder's file system do not matter.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from orchestrate.store import database_url
from orchestrate.store.backends.backups import copy_checked
from orchestrate.store.backends.driver_errors import translated, translated_file
from orchestrate.store.doctor import TrialKey
from orchestrate.store.errors import NoDatabaseError
from orchestrate.store.merging.merge import Merged, merge

SUFFIX = ".db"


def collect(url: str, folder: Path) -> None:
    """Copy a SQLite database, which launches may be writing, to a file of its name in a folder.

    Raises ``StoreUnavailableError`` if the folder has no room or fails, and ``StoreError`` if it
    can never be written; an older copy stays then.
    """
    path = database_url.sqlite_path(database_url.parse(url))
    partial = folder / f"{path.name}.{os.getpid()}.partial"
    with (
        translated_file(str(folder)),
        translated(url),
        tempfile.TemporaryDirectory(dir=path.parent) as local,
    ):
        copy = Path(local) / path.name
        copy_checked(path, copy)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            shutil.copyfile(copy, partial)
            with partial.open("rb") as written:
                os.fsync(written.fileno())
            partial.replace(folder / path.name)
        finally:
            partial.unlink(missing_ok=True)


def merge_collected(
    url: str, folder: Path, pattern: str = f"*{SUFFIX}", trial_key: TrialKey | None = None
) -> Iterator[Merged]:
    """Merge the copies in a folder into a database, one after the other.

    Raises ``NoDatabaseError`` if there is none, and as :func:`merge` does.
    """
    found = sorted(folder.glob(pattern))
    if not found:
        raise NoDatabaseError(
            f"The folder {folder} holds no database ({pattern}): give one that launches with "
            "store=shards have written to."
        )
    for path in found:
        with tempfile.TemporaryDirectory() as local:
            copy = Path(local) / path.name
            with translated_file(str(path)):
                shutil.copyfile(path, copy)
            yield merge(url, f"sqlite:///{copy}", trial_key)
