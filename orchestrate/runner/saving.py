"""Writes of a launch or an exploration: operations that are retried, the heartbeat, provenance."""

from __future__ import annotations

import hashlib
import logging
import math
import os
import platform
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from dopt import __version__
from dopt.result import TrialResult
from dopt.spec.trial import MarkedTrial
from orchestrate.errors import without_password_in_word
from orchestrate.executors.base import record_of
from orchestrate.fingerprint import fingerprint
from orchestrate.program import COMMIT_VARIABLE, ROOT, commit_of, git
from orchestrate.records import Failure, RunRecord
from orchestrate.runner.progress import undisturbed
from orchestrate.store import (
    LEASE_SECONDS,
    Claim,
    DatabaseMovedError,
    LaunchRecord,
    Saved,
    Store,
    StoreError,
    StoreUnavailableError,
    default_url,
)

FIRST_PAUSE_SECONDS = 0.1
MAX_PAUSE_SECONDS = 3.0
"""Pauses between two tries; each is twice the one before, up to the maximum."""

IDEMPOTENT = {
    "recover": False,
    "retry": False,
    "final_losses": False,
    "register": True,
    "open_configs": True,
    "others": True,
    "open_trials": True,
    "suspects": True,
    "release": True,
    "end_launch": True,
}
"""Operations of :class:`Store` that may be executed twice, and whether they take the launch."""

T = TypeVar("T")
Say = Callable[[str], None]


@dataclass
class Patience:
    """Repetition of an operation on a database for ``seconds`` after its first failure.

    It is called with the operation, and with what to repeat where that is another one: a failed
    operation may have been executed, with only its answer lost.

    Raises
    ------
    StoreUnavailableError
        If the database stays unreachable, or at once if waiting cannot help.
    """

    seconds: float
    say: Say

    def hurry(self) -> None:
        """Wait no longer for a database that does not answer; a signal handler may call it."""
        self.seconds = 0.0

    def __call__(self, operation: Callable[[], T], again: Callable[[], T] | None = None) -> T:
        failed, pause = 0.0, FIRST_PAUSE_SECONDS
        while True:
            try:
                result = operation()
            except StoreUnavailableError as error:
                now = time.monotonic()
                if not error.transient or (failed and now - failed >= self.seconds):
                    raise
                if not failed:
                    failed, operation = now, again or operation
                    self.say(f"waiting for up to {self.seconds:g} s: {error}")
                time.sleep(max(0.0, min(pause, failed + self.seconds - now)))
                pause = min(2 * pause, MAX_PAUSE_SECONDS)
            else:
                if failed:
                    self.say(f"the database is back after {time.monotonic() - failed:.1f} s")
                return result


class RetryingStore:
    """Operations of one launch, each repeated by ``patience``.

    The operations of :data:`IDEMPOTENT` are repeated as they are, without the number of the launch
    as argument; ``claim``, ``commit`` and ``fail`` are repeated in a form that is harmless after
    one that was executed.

    Raises
    ------
    StoreUnavailableError
        From every method, as from :class:`Patience`.

    Attributes
    ----------
    alike : bool
        Whether only trials are claimed that code with the fingerprint of this launch registered.
    safe_url : str
        The URL without a password.
    """

    alike = False

    def __init__(self, store: Store, launch: int, patience: Patience) -> None:
        self._store = store
        self._launch = launch
        self._patience = patience
        self.hurry = patience.hurry
        self.safe_url = store.safe_url

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name not in IDEMPOTENT:
            raise AttributeError(name)
        launch = (self._launch,) if IDEMPOTENT[name] else ()
        operation = partial(getattr(self._store, name), *launch)
        return lambda *words: self._persist(lambda: operation(*words))

    def check(self) -> None:
        """Raise ``DatabaseMovedError`` if the file was removed, renamed or replaced."""
        self._store.check()

    def claim(self, trial_keys: Sequence[str]) -> list[Claim]:
        """Claim the pending ones of the trials, none of which the launch holds."""
        only = {"alike": True} if self.alike else {}

        def claim() -> list[Claim]:
            return self._store.claim(self._launch, trial_keys, **only)

        def again() -> list[Claim]:
            self._store.release(self._launch, trial_keys)
            return claim()

        return self._persist(claim, again)

    def commit(self, items: Sequence[tuple[Claim, TrialResult, RunRecord]]) -> list[bool]:
        """Write finished trials; False for each whose claim is lost."""
        claims = [claim for claim, _, _ in items]

        def again() -> list[bool]:
            written = self._store.commit_many(items)
            return written if all(written) else self._store.written(claims)

        return self._persist(lambda: self._store.commit_many(items), again)

    def fail(self, claim: Claim, failure: Failure, run: RunRecord) -> bool:
        """Write a failed trial; False where the claim is lost."""

        def again() -> bool:
            return self._store.fail(claim, failure, run) or self._store.written([claim])[0]

        return self._persist(lambda: self._store.fail(claim, failure, run), again)

    def _persist(self, operation: Callable[[], T], again: Callable[[], T] | None = None) -> T:
        return self._patience(partial(_whole, operation), partial(_whole, again or operation))


def _whole(operation: Callable[[], T]) -> T:
    with undisturbed():
        return operation()


HEARTBEATS_PER_LEASE = 6
"""Heartbeats in one lease, so that a few may fail."""

JOIN_TIMEOUT_SECONDS = 2.0
"""Time for the last heartbeat to finish."""


@contextmanager
def kept_alive(store: Store, launch: int, lease_seconds: float) -> Iterator[None]:
    """Renew the lease of a launch from a thread while the block runs.

    It ignores a lost database, which the main thread notices too. A lease that has run out is
    renewed all the same: what others claimed meanwhile is refused when it is committed.
    """
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(lease_seconds / HEARTBEATS_PER_LEASE):
            with suppress(Exception):  # a failed heartbeat must not be the last one
                store.heartbeat(launch)

    thread = threading.Thread(target=beat, name="heartbeat", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(JOIN_TIMEOUT_SECONDS)


_log = logging.getLogger("dopt.explorer")


class ExplorationSaver:
    """Launch that one process saves one exploration or fit in; any thread may save.

    Parameters
    ----------
    url : str or None
        Database, by default :func:`orchestrate.store.default_url`; it is made if it does not exist.

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
        self._token: str | None = None
        self._launch: int | None = None
        self._alive = ExitStack()
        self._last: Saved | None = None

    def save(self, spec: MarkedTrial, result: TrialResult) -> bool:
        """Write an exploration or a fit; return False if the database holds more steps of it.

        ``wall_seconds`` of the result may be NaN, where the duration is not known.

        Raises
        ------
        StoreError
            If nothing was written: the database fails, or holds another exploration. If its file
            was removed, renamed or replaced, the next save opens the URL again.
        """
        with self._lock:
            self._store = self._store or _opened(self._url)
            try:
                return self._save(self._store, spec, result)
            except DatabaseMovedError:
                self._end()
                raise

    def _save(self, store: Store, spec: MarkedTrial, result: TrialResult) -> bool:
        if self._launch is None:
            if store.holds_more(spec, result):
                return False
            self._token = self._token or store.new_token()
            self._launch = store.begin_launch(self._record, self._token)
            self._alive.enter_context(kept_alive(store, self._launch, LEASE_SECONDS))
        last, self._last = self._last, None  # whether a save that fails has written is unknown
        known = result.wall_seconds if math.isfinite(result.wall_seconds) else 0.0
        started = datetime.now(UTC) - timedelta(seconds=known)
        run = record_of(started, result.wall_seconds, result.cpu_seconds)
        self._last = store.save(self._launch, spec, result, run, last)
        return self._last is not None

    def close(self) -> None:
        """End the launch and close the database."""
        if os.getpid() != self._record.pid:
            return  # a process that was forked, whose parent goes on
        with self._lock:
            self._end()

    def _end(self) -> None:
        store, launch = self._store, self._launch
        self._store = self._token = self._launch = self._last = None
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
    versions = {"python": platform.python_version(), "dopt": __version__}
    for name in LIBRARIES:
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return LaunchRecord(
        argv=[without_password_in_word(word) for word in argv],
        overrides=[without_password_in_word(word) for word in overrides],
        host=socket.gethostname(),
        pid=os.getpid(),
        git_commit=commit or os.environ.get(COMMIT_VARIABLE) or None,
        git_dirty=bool(difference) if commit else None,
        git_diff_hash=hashlib.sha256(difference).hexdigest() if difference else None,
        versions={**versions, **_processor()},
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
    try:
        return hashlib.sha256((root / os.fsdecode(name)).read_bytes()).digest()
    except OSError:
        return b"unreadable"


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
