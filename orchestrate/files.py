"""Files that appear whole or not at all, and the error of what cannot be written."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dopt.errors import DoptError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


class OutputError(DoptError):
    """File or folder that cannot be written, such as on a full disk."""


@contextmanager
def writing(path: Path, argument: str = "--out") -> Iterator[None]:
    """Raise ``OutputError``, with ``path`` and the cause, if the system refuses a write.

    ``argument`` is what gave the path.
    """
    try:
        yield
    except Exception as error:
        reason = _reason(error)
        if reason is None:
            raise
        raise OutputError(
            f"{path} cannot be written ({reason}): make room and check that its folder is yours, "
            f"or choose another {argument}."
        ) from error


def _reason(error: Exception) -> str | None:
    """Return why the system refused a write; None for an error of another kind.

    Libraries may raise errors of their own from it, or while they close what they could not write.
    """
    one: BaseException | None = error
    while one is not None and not isinstance(one, DoptError):
        if isinstance(one, OSError) and (one is error or one.errno in _FULL):
            return os.strerror(one.errno) if one.errno else str(one)
        if "disk is full" in str(one):  # of SQLite
            return os.strerror(errno.ENOSPC)
        one = one.__context__
    return None


def make_folder(path: Path) -> None:
    """Make a folder to write to, or raise ``OutputError``."""
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)


@contextmanager
def whole(path: Path, argument: str = "--out") -> Iterator[Path]:
    """Yield a path to write to, in the same folder; it takes the place of ``path`` at the end.

    After an error there is nothing new at ``path``. Raises ``OutputError``.
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    with writing(path, argument):
        if path.exists() and not path.is_file():
            raise OSError("it is no file, and stays as it is")
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield partial
            with partial.open("rb") as file:
                os.fsync(file.fileno())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
