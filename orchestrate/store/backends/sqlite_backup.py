"""Backup of a SQLite database as a file beside it."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from itertools import chain, count
from pathlib import Path

from orchestrate.store.errors import StoreUnavailableError


def copy_file(path: Path, version: int) -> Path:
    """Copy a SQLite database with its log to a file beside it and return the path.

    The copy is checked and synchronised to disk before it gets its name; an existing file is never
    replaced.
    """
    target = _free_name(f"{path}.v{version}-backup")
    partial = target.with_name(f"{target.name}.partial")
    try:
        copy_checked(path, partial)
        partial.rename(target)
    except OSError as error:
        raise StoreUnavailableError(
            f"The backup {target} cannot be made ({error.strerror}): make room or its folder "
            "writable, or make a copy yourself and give --no-backup."
        ) from error
    finally:
        partial.unlink(missing_ok=True)
    return target


def _free_name(base: str) -> Path:
    names = map(Path, chain([base], (f"{base}-{i}" for i in count(2))))
    return next(name for name in names if not name.exists())


def copy_checked(path: Path, partial: Path) -> None:
    """Copy a SQLite database with its log to one file, and check it."""
    partial.unlink(missing_ok=True)
    with (
        contextlib.closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as source,
        contextlib.closing(sqlite3.connect(partial)) as copy,
    ):
        source.backup(copy)
        copy.execute("PRAGMA journal_mode = DELETE")  # one file, complete in itself
        (verdict,) = copy.execute("PRAGMA quick_check(1)").fetchone()
    if verdict != "ok":
        raise StoreUnavailableError(
            f"The results database {path} is damaged ({verdict}): nothing was changed; restore a "
            "copy of it."
        )
    descriptor = os.open(partial, os.O_RDONLY)
    os.fsync(descriptor)
    os.close(descriptor)
