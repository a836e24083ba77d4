"""SQLite backend: one writer at a time, write-ahead log, liveness by kernel file locks.

Locks are locks of the kernel, which end with the process that holds them. The write-ahead log is
shared memory, which one machine, or a virtual one and its host, cannot share with another
(https://www.sqlite.org/wal.html), and the locks of many network file systems fail: SQLite is used
on file systems that are known to be safe.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import sqlite3
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, partial
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, cast
from urllib.parse import quote

from sqlalchemy import (
    URL,
    Connection,
    Engine,
    Select,
    create_engine,
    event,
    func,
    insert,
    select,
    text,
)
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.pool import QueuePool

from dopt.types import Array
from orchestrate.errors import (
    DatabaseMovedError,
    NoDatabaseError,
    StoreError,
    StoreUnavailableError,
)
from orchestrate.store.backend import (
    ANNOUNCE_SECONDS,
    Backend,
    LaunchLife,
    NewTrial,
    back_up_to,
    copy_checked,
    log,
    public_url,
    rescue,
    sqlite_path,
    translated_file,
)
from orchestrate.store.schema import STEP_VALUES, VIEWS, trial

MOUNT_TABLE = Path("/proc/self/mountinfo")

SAFE_VARIABLE = "DOPT_SAFE_FILE_SYSTEMS"
"""Environment variable with further kinds of file systems that its user knows to be safe."""

_SAFE = frozenset(
    {
        *("ext2", "ext3", "ext4", "xfs", "btrfs", "zfs", "bcachefs", "f2fs", "jfs", "nilfs2"),
        *("reiserfs", "ufs", "apfs", "hfs", "hfsplus", "ubifs", "simfs"),
        *("vfat", "msdos", "exfat", "ntfs", "ntfs3", "fuseblk", "udf", "iso9660", "squashfs"),
        *("tmpfs", "ramfs", "devtmpfs", "rootfs", "overlay", "overlayfs", "aufs", "ecryptfs"),
    }
)
"""File systems of disks and memory of this machine, and layers over them."""

_LOCAL_PROGRAMS = frozenset(
    {"mergerfs", "fuse-overlayfs", "bindfs", "ntfs-3g", "exfat", "gocryptfs", "encfs", "cryfs"}
)
"""Programs that serve a file system by FUSE from disks of this machine."""


class Mount(NamedTuple):
    """Mounted file system."""

    folder: PurePosixPath
    kind: str  # such as ext4, or fuse.sshfs


def refuse_unsafe(path: Path, safe_url: str) -> None:
    """Raise ``StoreError`` if the file of a database would be where SQLite is not known to be safe.

    ``path`` is absolute, and neither it nor its folder has to exist. Where the system has no table
    of mounts, nothing is refused.
    """
    try:
        table = MOUNT_TABLE.read_text(errors="surrogateescape")
    except OSError:
        return
    mount = mount_of(PurePosixPath(path), table)
    if mount is not None and is_network(mount.kind):
        raise StoreError(
            f"The results database {safe_url} would be on {mount.folder}, whose file system "
            f"({mount.kind}) is not known to keep the log and the locks of SQLite whole, so that "
            "results can be lost or damaged, but a disk of this machine is expected: give a file "
            "on one, such as store.url=sqlite:////var/tmp/results.db (in a container a volume, in "
            "WSL a folder of Linux), and copy it afterwards, use PostgreSQL (store=postgresql), "
            "which many machines share, or let each machine write some seeds to its own disk "
            "(docs/example/share.sh). If you know that it is safe, set "
            f"{SAFE_VARIABLE}={mount.kind}."
        )


def mount_of(path: PurePosixPath, table: str) -> Mount | None:
    """Return the file system that holds an absolute path, given the text of ``mountinfo``.

    It is the innermost one; of several at the same folder, the last one hides the others.
    """
    holding = None
    for line in table.splitlines():
        before, found, after = line.partition(" - ")
        if not found:
            continue
        # Special characters, such as a space, are octal codes there.
        folder = re.sub(r"\\([0-7]{3})", lambda code: chr(int(code[1], 8)), before.split(" ")[4])
        mount = Mount(PurePosixPath(folder), after.split(" ")[0])
        if path.is_relative_to(mount.folder) and (
            holding is None or len(mount.folder.parts) >= len(holding.folder.parts)
        ):
            holding = mount
    return holding


def is_network(kind: str) -> bool:
    """Return whether a kind of file system is taken for one that several machines share.

    Every kind is that is not known to be safe, and that ``DOPT_SAFE_FILE_SYSTEMS`` does not name.
    """
    system, _, program = kind.partition(".")
    safe = program in _LOCAL_PROGRAMS if system == "fuse" else kind in _SAFE
    return not safe and kind not in re.split(r"[,\s]+", os.environ.get(SAFE_VARIABLE, ""))


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
        """Create and lock the file of a token, unless that is done."""
        if token in self._descriptors:
            return
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


BUSY_TIMEOUT_SECONDS = 30.0

MAX_LOG_BYTES = 16 * 2**20
"""Size to which the log is truncated after a long read transaction."""


def read_engine(url: URL) -> Engine:
    """Return an engine that cannot write; raise ``NoDatabaseError`` if there is no file."""
    path = existing_path(url)

    def reader() -> sqlite3.Connection:
        connection = _connect(read_address(path))
        for name, query in VIEWS.items():  # first: a stranger may have made views of the file
            connection.execute(f"CREATE TEMP VIEW {name} AS {query}")
        return connection

    return _engine(reader, lambda connection: connection.exec_driver_sql("BEGIN"))


def existing_path(url: URL) -> Path:
    """Return the path of a database.

    Raises ``NoDatabaseError`` if there is nothing, ``StoreError`` for what is no file.
    """
    path = sqlite_path(url)
    with translated_file(public_url(url)):
        _refuse_others(path, public_url(url))
        there = path.is_file()
    if not there:
        raise NoDatabaseError(
            f"There is no results database at {public_url(url)}: run a launch that writes "
            "it, or give the URL of another one (--db, or the variable DOPT_DB)."
        )
    return path


def _refuse_others(path: Path, url: str) -> None:
    """Refuse what is there and is no file."""
    if path.is_dir():
        raise StoreError(
            f"The results database {url} is a folder, but a file is expected: give one in it, such "
            f"as sqlite:///{path / 'results.db'}."
        )
    if path.exists() and not path.is_file():
        raise StoreError(
            f"The results database {url} is a device, a pipe or a socket, but a file is expected: "
            "give another path."
        )


def write_engine(connect: Callable[[], sqlite3.Connection], path: Path, patience: float) -> Engine:
    """Return an engine whose connections are made by ``connect``, as by :func:`writer`.

    A transaction that reads before it writes fails under load unless it locks at its beginning.
    """

    def begin(connection: Connection) -> None:
        memory = path.with_name(f"{path.name}-shm")
        _executed(driver_of(connection), "BEGIN IMMEDIATE", patience, path, memory)

    return _engine(connect, begin)


def _executed(
    connection: sqlite3.Connection, statement: str, patience: float, name: Path, path: Path
) -> list[Any]:
    """Execute a statement, which waits for a lock of ``path`` as :func:`patiently` does."""
    rows: list[Any] = []

    def locked(seconds: float) -> bool:
        connection.execute(f"PRAGMA busy_timeout = {round(1000 * seconds)}")
        try:
            rows.extend(connection.execute(statement))
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY:  # of any kind
                raise
            return False
        return True

    patiently(locked, patience, name, path)
    return rows


def _engine(connect: Any, begin: Callable[[Connection], object]) -> Engine:
    engine = create_engine("sqlite://", creator=connect, poolclass=QueuePool)
    event.listen(engine, "begin", begin)
    return engine


def _address(path: Path, mode: str) -> str:
    return f"file:{quote(str(path))}?{mode}"


def _connect(address: str) -> sqlite3.Connection:
    connection = sqlite3.connect(
        address,
        uri=True,
        timeout=BUSY_TIMEOUT_SECONDS,
        isolation_level=None,  # the engine says BEGIN
        check_same_thread=False,  # the pool hands a connection to one thread at a time
    )
    connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
    return connection


def writer(
    path: Path, create: bool, check: Callable[[], None], patience: float
) -> sqlite3.Connection:
    """Open a file for writing, or create it; ``check`` refuses it before anything is changed."""
    _refuse_read_only(path)
    check()
    connection = _connect(_address(path, "mode=rwc" if create else "mode=rw"))
    check()
    names = "SELECT name FROM sqlite_master"
    tables = [row[0] for row in _executed(connection, names, patience, path, path)]
    if not tables or "trial" in tables:  # a file of another program is not changed
        _executed(connection, "PRAGMA journal_mode = WAL", patience, path, path)
    # A committed trial survives a power cut. Measured against NORMAL, with trials of 300 rows: 1.4
    # instead of 1.1 ms for one alone, 388,000 instead of 397,000 rows/s for twenty together.
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute(f"PRAGMA journal_size_limit = {MAX_LOG_BYTES}")
    connection.execute("PRAGMA foreign_keys = ON")
    return connection


def watcher(path: Path) -> sqlite3.Connection:
    """Open a file that a writer has open, so that its content can be read if its name is lost.

    The connection cannot write: closed as the last one, it leaves the files as they are.
    """
    connection = _connect(_address(path, "mode=ro"))
    connection.execute("SELECT count(*) FROM sqlite_master")  # opens the log too
    return connection


def _refuse_read_only(path: Path) -> None:
    """Raise ``StoreUnavailableError`` before SQLite creates read-only files beside a read-only one.

    They would stay read-only after the file itself becomes writable.
    """
    for suffix in ("", "-wal", "-shm"):
        file = path.with_name(path.name + suffix)
        if _is_read_only(file):
            raise StoreUnavailableError(
                f"The results database {path} cannot be written, because {file} is read-only: "
                "make it writable or give another path."
            )


def _is_read_only(file: Path) -> bool:
    # Another process may delete the log beside the database at any moment, and create it again.
    try:
        number = file.stat().st_ino
        return not os.access(file, os.W_OK) and file.stat().st_ino == number
    except FileNotFoundError:
        return False


def read_address(path: Path) -> str:
    """Return the address with which SQLite opens a file that it cannot write."""
    # A database in WAL mode is read through two files beside it. On a medium where they cannot be
    # created, there are no writers, and the file is read as immutable.
    wal = path.with_name(path.name + "-wal")
    if not wal.exists() and not os.access(path.parent, os.W_OK):
        return _address(path, "mode=ro&immutable=1")
    return _address(path, "mode=ro")


def driver_of(connection: Connection) -> sqlite3.Connection:
    driver: Any = connection.connection.driver_connection
    return cast("sqlite3.Connection", driver)


# Rows in one statement: its 502 parameters stay below the 999 that every SQLite takes.
_BLOCK = 100

_LOGS = ("-wal", "-shm")
_SIZE = text("SELECT page_count * page_size FROM pragma_page_count, pragma_page_size")
_TRUNCATE = "PRAGMA wal_checkpoint(TRUNCATE)"


class SQLiteBackend(Backend):
    """SQLite file, with its locks in the folder ``<file>-locks`` beside it."""

    def __init__(self, url: URL, patience: float) -> None:
        self._path = sqlite_path(url)
        self._given = Path(str(url.database)).absolute()
        self._folder = _locks_folder(self._path)
        self._patience = patience
        self._opened: list[tuple[int, int] | None] = []
        self._watcher: sqlite3.Connection | None = None
        self._moved = ""
        self._saved: Path | None = None
        self._checking = threading.RLock()
        engine = write_engine(self._connect, self._path, patience)
        super().__init__(engine, public_url(url))
        refuse_unsafe(self._path, self.safe_url)
        with translated_file(self.safe_url):
            _refuse_others(self._path, self.safe_url)
            self._folder.mkdir(parents=True, exist_ok=True)
        self._locks = LaunchLocks(self._folder)

    def _connect(self) -> sqlite3.Connection:
        new = not self._opened
        if new and not self._path.exists():  # the log of a removed file is no log of a new one
            for name in _LOGS:
                Path(f"{self._path}{name}").unlink(missing_ok=True)
        return writer(self._path, new, self.check, self._patience)

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        with super().transaction() as connection:
            self._remember()
            yield connection
        # What was committed went to the opened file, wherever that is, and is saved with the rest.
        self.check(written=True)

    def _remember(self) -> None:
        """Note which files are open, and keep a connection to them, at the first transaction."""
        if not self._opened:
            self._watcher = watcher(self._path)
            self._opened = self._files()

    def _files(self) -> list[tuple[int, int] | None]:
        """Return the identities of the file that the URL names and of the logs in use."""
        return [identity(self._given), *(identity(Path(f"{self._path}{s}")) for s in _LOGS)]

    def check(self, written: bool = False) -> None:
        with self._checking:
            moved = self._moved or (self._opened and self._files() != self._opened)
            if moved and (written or not self._moved):
                self._moved = self._rescued()
                self._empty_log()
            if moved:
                raise DatabaseMovedError(self._moved)

    def _rescued(self) -> str:
        """Save what the opened file holds and return a sentence about it."""
        file, *_ = self._files()
        what = "was replaced by another file" if file else "was removed or renamed"
        if file == self._opened[0]:
            what = f"lost its log {self._path.name}-wal"
        assert self._watcher is not None
        try:
            self._saved = rescue(self._watcher, self._path, self._saved)
            saved = f"what it held is saved in {self._saved}"
            more = "put the saved file in its place and "
        except (OSError, sqlite3.Error, StoreUnavailableError) as error:
            saved = f"what it held cannot be saved beside it or in the temporary folder ({error})"
            more = ""
        place = _place(self._opened[0])
        now = f" and is now {place}" if place not in ("", os.path.realpath(self._given)) else ""
        return (
            f"The results database {self.safe_url} {what} since it was opened{now}; {saved}: {more}"
            "run the same command again to continue (an Explorer that saves again writes all of "
            "it there)."
        )

    @contextmanager
    def creation(self) -> Iterator[Connection]:
        # The change to WAL is outside transactions and fails if two processes attempt it.
        with ExitStack() as stack:
            with translated_file(self.safe_url):
                stack.enter_context(file_lock(self._folder / "create", self._patience))
            yield stack.enter_context(self.transaction())

    def back_up(self, connection: Connection, version: int) -> str:  # noqa: ARG002
        write = partial(copy_checked, self._path)
        return back_up_to(f"{self._path}.v{version}-backup", "", write)

    def members(self, keys: Sequence[str]) -> Select[Any]:
        return select(func.json_each(json.dumps(list(keys))).table_valued("value").c.value)

    def insert_trials(
        self, connection: Connection, trials: Sequence[NewTrial], launch_id: int
    ) -> None:
        more = {"status": "pending", "attempt": 0, "registered_by": launch_id}
        rows = [{**one._asdict(), **more} for one in trials]
        connection.execute(insert(trial), rows)

    def insert_steps(
        self, connection: Connection, trial_id: int, values: Array, first: int = 0
    ) -> None:
        whole = len(values) - len(values) % _BLOCK
        for start, part, size in ((0, values[:whole], _BLOCK), (whole, values[whole:], None)):
            if len(part):
                _insert_blocks(connection, trial_id, first + start, part, size or len(part))

    def hold(self, token: str) -> None:
        with translated_file(self.safe_url):
            self._locks.acquire(token)

    def dead(self, connection: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:  # noqa: ARG002
        return [launch for launch in launches if not self._locks.is_held(launch.token)]

    def forget(self, token: str) -> None:
        self._locks.release(token)

    def close(self) -> None:
        with suppress(DatabaseMovedError):
            self.check()
        self._locks.close()
        if self._moved:
            self.engine.dispose()  # first, as the watcher writes nothing when it is the last one
        if self._watcher:
            self._watcher.close()
        self.engine.dispose()

    def _empty_log(self) -> None:
        """Empty the log of a file that was renamed or replaced, which the next one would read.

        A log that others have made since may share the memory of this one.
        """
        _, log, memory = (a == b for a, b in zip(self._files(), self._opened, strict=True))
        if log or not memory:
            failures = suppress(SQLAlchemyError, sqlite3.Error, StoreError)
            with failures, self.engine.connect() as connection:
                driver_of(connection).execute(_TRUNCATE)
        if log and self._saved and self._opened[0] != identity(self._path):
            with suppress(OSError):  # no connection of the pool was left
                os.truncate(f"{self._path}-wal", 0)


def identity(path: Path) -> tuple[int, int] | None:
    """Return device and inode of a file, or None without a file."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _place(wanted: tuple[int, int] | None) -> str:
    """Return the present path of an open file; empty if it was deleted, or is not known."""
    with suppress(OSError):
        for link in Path("/proc/self/fd").iterdir():
            if identity(link) == wanted and not str(link.readlink()).endswith(" (deleted)"):
                return str(link.readlink())
    return ""


def _locks_folder(path: Path) -> Path:
    return path.with_name(path.name + "-locks")


def _insert_blocks(
    connection: Connection, trial_id: int, start: int, values: Array, size: int
) -> None:
    blocks = values.reshape(-1, size * values.shape[1]).tolist()
    connection.exec_driver_sql(
        _insert_block(size),
        # SQLite stores a bound NaN as NULL.
        [(trial_id, start + i * size, *numbers) for i, numbers in enumerate(blocks)],
    )


@cache
def _insert_block(n: int) -> str:
    """Return an INSERT of n steps in a row; ?1 is the trial, ?2 the first t, then row by row.

    Sharing the first two parameters, and the statement, between many rows is nearly twice as fast
    as one row a statement through ``executemany``.
    """
    width = len(STEP_VALUES)
    rows = (
        f"(?1, ?2 + {i}, {', '.join(f'?{3 + width * i + j}' for j in range(width))})"
        for i in range(n)
    )
    return f"INSERT INTO step (trial_id, t, {', '.join(STEP_VALUES)}) VALUES {', '.join(rows)}"


def dead(url: URL, _: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:
    """Return the launches whose process is gone, for a reader."""
    locks = LaunchLocks(_locks_folder(sqlite_path(url)))
    with translated_file(public_url(url)):
        return [launch for launch in launches if not locks.is_held(launch.token)]


def size(connection: Connection) -> int:
    """Return the bytes of the database, without its log."""
    return int(connection.execute(_SIZE).scalar_one())


def request(url: URL) -> dict[str, Any]:
    """Return how the process of a query opens the file."""
    return {"driver": "sqlite", "file": read_address(existing_path(url))}
