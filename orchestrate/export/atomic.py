"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from orchestrate.export.wanted import ExportError


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Yield a path to write to, in the same folder; it takes the place of ``path`` at the end.

    After an error there is nothing new at ``path``.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path, is_replaceable: Callable[[Path], bool]) -> Iterator[Path]:
    """Yield a new folder to write to, beside ``path``; it takes the place of ``path`` at the end.

    After an error there is nothing new at ``path``. Raises ``ExportError`` if there is something at
    ``path`` other than an empty folder or one for which ``is_replaceable`` is true.
    """
    if path.exists() and not (path.is_dir() and (not any(path.iterdir()) or is_replaceable(path))):
        raise ExportError(
            f"{path} is there already and is no earlier export of this kind, a new or an empty "
            f"folder is expected: give another one, or remove it."
        )
    path = path.absolute()
    path.parent.mkdir(parents=True, exist_ok=True)
    mark = uuid.uuid4().hex  # libraries may remember what they wrote at a path
    partial, old = (path.with_name(f".{path.name}.{mark}.{kind}") for kind in ("partial", "old"))
    try:
        partial.mkdir()
        yield partial
        if path.exists():
            path.rename(old)
        partial.rename(path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
