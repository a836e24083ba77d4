"""Kernel file locks, which end with the process that holds them."""

from __future__ import annotations

import fcntl
import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_held: weakref.WeakSet[LaunchLocks] = weakref.WeakSet()


@contextmanager
def file_lock(path: Path) -> Iterator[None]:
    """Hold the lock of a file, which is created if needed; wait for other holders."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


class LaunchLocks:
    """Set of locked files, one for each living launch of a database."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._descriptors: dict[str, int] = {}
        _held.add(self)

    def acquire(self, token: str) -> None:
        """Create and lock the file of a new token."""
        descriptor = os.open(self._path(token), os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._descriptors[token] = descriptor

    def is_held(self, token: str) -> bool:
        """Return whether a process, this one included, holds the lock."""
        try:
            descriptor = os.open(self._path(token), os.O_RDONLY)
        except FileNotFoundError:
            return False
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(descriptor)
        return False

    def release(self, token: str) -> None:
        """Unlock and delete the file of a launch that has ended or died."""
        self._path(token).unlink(missing_ok=True)
        descriptor = self._descriptors.pop(token, None)
        if descriptor is not None:
            os.close(descriptor)

    def close(self) -> None:
        """Release all locks; the files stay, so that other processes see the launches as dead."""
        for descriptor in self._descriptors.values():
            os.close(descriptor)
        self._descriptors.clear()

    def _path(self, token: str) -> Path:
        return self._folder / f"launch-{token}"


def _close_in_child() -> None:
    # A forked worker shares the lock and would hold it after the death of the launch.
    for locks in _held:
        locks.close()


os.register_at_fork(after_in_child=_close_in_child)
