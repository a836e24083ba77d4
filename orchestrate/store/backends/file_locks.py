"""Kernel file locks, which end with the process that holds them."""

from __future__ import annotations

import fcntl
import os
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from orchestrate.store.backends.base import ANNOUNCE_SECONDS, log
from orchestrate.store.errors import StoreUnavailableError

LOCK_TABLE = Path("/proc/locks")

_PAUSE_SECONDS = 0.02

_held: weakref.WeakSet[LaunchLocks] = weakref.WeakSet()


@contextmanager
def file_lock(path: Path, patience: float) -> Iterator[None]:
    """Hold the lock of a file, which is created if needed; wait as :func:`patiently` does."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)

    def locked(seconds: float) -> bool:
        end = time.monotonic() + seconds
        while True:
            with suppress(BlockingIOError):
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return True
            if time.monotonic() >= end:
                return False
            time.sleep(_PAUSE_SECONDS)

    try:
        patiently(locked, patience, path, path)
        yield
    finally:
        os.close(descriptor)


def patiently(locked: Callable[[float], bool], patience: float, name: Path, path: Path) -> None:
    """Call ``locked``, which waits for the given seconds and returns whether it has locked a file.

    After two seconds a warning says who holds the lock of ``path``, and after ``patience`` seconds
    ``StoreUnavailableError`` is raised.
    """
    first = min(ANNOUNCE_SECONDS, patience)
    if locked(first):
        return
    log.warning("waiting for a lock of %s, which %s holds", name, holder(path))
    if not locked(patience - first):
        raise StoreUnavailableError(
            f"The file {name} cannot be used: {holder(path)} has locked it for more than "
            f"{patience:g} s; end it, and run the same command again."
        )


def holder(path: Path) -> str:
    """Return the process that has locked a file for writing, as far as the kernel tells."""
    with suppress(OSError):
        inode = f":{path.stat().st_ino}"
        for line in LOCK_TABLE.read_text().splitlines():
            words = line.split()  # 1: POSIX ADVISORY WRITE 4711 08:01:131 120 120
            if "->" not in words and "WRITE" in words and words[5].endswith(inode):
                return f"process {words[4]}"
    return "another process"


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
