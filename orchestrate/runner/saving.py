"""Records of a launch or an exploration: its provenance, and an exploration as trials."""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import resource
import socket
import sys
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from importlib import metadata
from pathlib import Path

from dopt import __version__
from dopt.result import TrialResult
from orchestrate.executors.base import BYTES_PER_KIB
from orchestrate.fingerprint import fingerprint
from orchestrate.program import COMMIT_VARIABLE, commit_of, git
from orchestrate.redaction import without_password_in_word
from orchestrate.runner.retrying_store import Heartbeat
from orchestrate.store import (
    LEASE_SECONDS,
    DatabaseMovedError,
    LaunchRecord,
    Registrable,
    RunRecord,
    Saved,
    Store,
    StoreError,
    default_url,
)

ROOT = Path(__file__).resolve().parents[2]

_log = logging.getLogger("dopt.explorer")


class ExplorationSaver:
    """Launch that one process saves one exploration in; any thread may save.

    Parameters
    ----------
    url : str or None
        Database, by default that of a launch (:func:`orchestrate.store.default_url`); it is made
        if there is none.

    Raises
    ------
    StoreError
        If the URL names no database that can be written.
    """

    def __init__(self, url: str | None) -> None:
        self._record = launch_record(sys.argv, [], ROOT)
        self._url = default_url() if url is None else str(url)
        self._store: Store | None = _opened(self._url)
        self._lock = threading.Lock()
        self._launch: int | None = None
        self._alive = ExitStack()
        self._last: Saved | None = None

    def save(self, spec: Registrable, result: TrialResult) -> bool:
        """Write an exploration; return False if the database holds more steps of it.

        Raises
        ------
        StoreError
            If nothing was written: the database fails, or holds another exploration. If its file
            was removed, renamed or replaced, the next save opens the URL anew.
        """
        with self._lock:
            self._store = self._store or _opened(self._url)
            try:
                return self._save(self._store, spec, result)
            except DatabaseMovedError:
                self._end()
                raise

    def _save(self, store: Store, spec: Registrable, result: TrialResult) -> bool:
        if self._launch is None:
            if store.holds_more(spec, result):
                return False
            self._launch = store.begin_launch(self._record)
            self._alive.enter_context(Heartbeat(store, self._launch, LEASE_SECONDS))
        last, self._last = self._last, None  # whether a save that fails has written is unknown
        self._last = store.save(self._launch, spec, result, _run_record(result), last)
        return self._last is not None

    def close(self) -> None:
        """End the launch and close the database."""
        if os.getpid() != self._record.pid:
            return  # a process that was forked, whose parent goes on
        with self._lock:
            self._end()

    def _end(self) -> None:
        store, launch = self._store, self._launch
        self._store = self._launch = self._last = None
        self._alive.close()
        if store is None:
            return
        try:
            if launch is not None:
                store.end_launch(launch, "done", 0)
        except DatabaseMovedError:
            pass  # the save has said so
        except (StoreError, ValueError) as error:  # the latter if its row was deleted
            _log.warning("the launch of the saves could not be ended: %s", error)
        finally:
            store.close()


def _opened(url: str) -> Store:
    store = Store.open(url, LEASE_SECONDS)
    try:
        store.recover()  # marks the launch of a process that was killed as lost
    except StoreError:
        store.close()
        raise
    return store


def _run_record(result: TrialResult) -> RunRecord:
    now = datetime.now(UTC)
    return RunRecord(
        node=socket.gethostname(),
        pid=os.getpid(),
        wall_seconds=result.wall_seconds,
        cpu_seconds=result.cpu_seconds,
        peak_memory_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * BYTES_PER_KIB,
        started=now - timedelta(seconds=result.wall_seconds),
        ended=now,
    )


LIBRARIES = (
    "hydra-core",
    "llvmlite",
    "numba",
    "numpy",
    "omegaconf",
    "psycopg",
    "ray",
    "scipy",
    "sqlalchemy",
    "torch",
)

LARGEST_FILE_BYTES = 16 * 2**20
"""Largest untracked file that is hashed; of a larger one the size is taken."""

SOURCES = ("*.py", "*.yaml", "*.yml", "*.toml", ":(exclude)build", ":(exclude)dist")
"""Git path patterns of untracked files that can change a result: code and configuration."""


def launch_record(argv: Sequence[str], overrides: Sequence[str], root: Path) -> LaunchRecord:
    """Return the provenance of this process, without passwords.

    Parameters
    ----------
    argv, overrides
        The command line, and what Hydra took as overrides.
    root
        Folder of the code, whose commit is noted if it is a git repository of its own, otherwise
        the one that ``DOPT_COMMIT`` gives.
    """
    commit = commit_of(root)
    difference = _difference(root) if commit else None
    return LaunchRecord(
        argv=[without_password_in_word(word) for word in argv],
        overrides=[without_password_in_word(word) for word in overrides],
        host=socket.gethostname(),
        pid=os.getpid(),
        git_commit=commit or os.environ.get(COMMIT_VARIABLE) or None,
        git_dirty=bool(difference) if commit else None,
        git_diff_hash=hashlib.sha256(difference).hexdigest() if difference else None,
        versions={**_versions(), **_processor()},
        fingerprint=fingerprint(),
    )


def _difference(root: Path) -> bytes:
    """Return the difference of the working tree from its commit, with untracked sources.

    Untracked files of other kinds, such as exported results, change no number and do not count.
    """
    changed = git(root, "diff", "--binary", "--no-ext-diff", "--no-textconv", "HEAD") or b""
    added = git(root, "ls-files", "--others", "--exclude-standard", "-z", "--", *SOURCES) or b""
    new = [name + b"\0" + _content(root, name) for name in sorted(added.split(b"\0")) if name]
    return b"\0".join([changed, *new]) if changed or new else b""


def _content(root: Path, name: bytes) -> bytes:
    """Return the hash of a file, or its size if it is too large."""
    path = root / os.fsdecode(name)
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE_BYTES:
            return str(size).encode()
        return hashlib.sha256(path.read_bytes()).digest()
    except OSError:
        return b"unreadable"


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version(), "dopt": __version__}
    for name in LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


def _processor() -> dict[str, str]:
    """Return the processor that the kernel is compiled for; rounding depends on it."""
    from llvmlite import binding

    features = binding.get_host_cpu_features().flatten()
    return {
        "platform": platform.platform(),
        "cpu": binding.get_host_cpu_name(),
        "cpu_model": _cpu_model(),
        "cpu_features": hashlib.sha256(features.encode()).hexdigest()[:16],
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())
