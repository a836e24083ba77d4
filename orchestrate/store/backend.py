"""Interface of a database backend, its URL, and the errors of its driver as errors of this package.

A backend has the operations that differ between SQLite and PostgreSQL. After a transient error
waiting may help. Copies are files: of SQLite a database, of PostgreSQL an archive of ``pg_dump``.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import shlex
import sqlite3
import subprocess
import tempfile
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

from sqlalchemy import URL, Connection, Engine, Select
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, DBAPIError

from dopt.errors import given_path, stripped
from dopt.types import Array
from orchestrate.errors import QueryError, SchemaVersionError, StoreError, StoreUnavailableError
from orchestrate.records import URL_VARIABLE

DEFAULT_URL = "sqlite:///results/results.db"

READ_VARIABLE = "DOPT_READ_DB"
"""Environment variable with the URL of a user who can only read, as whom the page SQL asks."""

_IN_MEMORY = ":memory:"
_EXAMPLES = "sqlite:///results/results.db or postgresql+psycopg://user@host:5432/name"
_SQLITE_FILE = re.compile(r"[\w./-]+\.(db|sqlite3?)")
"""Path of a file in place of a URL; a text that may hold a password does not match."""

_LETTERS = re.compile(r"(?:%[C-F][0-9A-F](?:%[89AB][0-9A-F])+)+")
"""Codes of letters beyond ASCII in UTF-8."""

_SECRETS = ("password", "sslpassword", "passfile")


def default_url() -> str:
    """Return the database that is used when none is given."""
    return os.environ.get(URL_VARIABLE) or DEFAULT_URL


def parse_url(url: str) -> URL:
    """Return the URL with its driver; raise ``StoreError`` if it names no supported database.

    The path of a file is read as :func:`dopt.errors.given_path` does. The message says whether
    the URL came from ``DOPT_DB`` or ``DOPT_READ_DB``. It repeats no text other than a path, because
    a mistyped URL may hold a password.
    """
    variables = (URL_VARIABLE, READ_VARIABLE)
    names = [name for name in variables if os.environ.get(name, "").strip() == url.strip() != ""]
    where = f" in the environment variable {names[0]}" if names else ""
    url = stripped(url, f"The database URL{where}", StoreError)
    if url != url.encode(errors="ignore").decode():
        raise StoreError(
            f"The database URL{where} holds bytes that are no text in UTF-8: rename the file or "
            "folder, or give another path."
        )
    if url and "://" not in url and Path(url).is_dir():
        raise StoreError(
            f"{url} is a folder, a database is expected{where}: merge the databases in it with "
            f"'python -m orchestrate merge {shlex.quote(url)} --db URL', and give that URL."
        )
    try:
        parsed = make_url(url)
    except (ArgumentError, ValueError):  # the latter for a port that is no number
        form = f"sqlite:///{url}" if _SQLITE_FILE.fullmatch(url) else _EXAMPLES
        raise StoreError(f"The database URL{where} cannot be read: write it as {form}.") from None
    backend = parsed.get_backend_name()
    if backend == "postgresql":
        return parsed.set(drivername="postgresql+psycopg")
    if backend != "sqlite":
        raise StoreError(
            f"A database of kind '{parsed.drivername}'{where} is not supported: give {_EXAMPLES}."
        )
    if parsed.host is not None:
        raise StoreError(
            f"The database URL sqlite://{parsed.host}/...{where} names a host, but SQLite has "
            f"none: write three slashes, sqlite:///{parsed.host}/{parsed.database or 'results.db'}."
        )
    if parsed.query:
        raise StoreError(
            f"The database URL{where} has a ?, behind which SQLite takes no options here: leave "
            "them out, and write ? in the name of a file as %3F."
        )
    if parsed.database and parsed.database != _IN_MEMORY:
        file = given_path(parsed.database, f"The path in the database URL{where}", StoreError)
        parsed = parsed.set(database=str(file))
    return parsed.set(drivername=backend)


def read_login(url: URL) -> URL | None:
    """Return the URL of the user who can only read, None where no variable names one of ``url``."""
    found = parse_url(os.environ[READ_VARIABLE]) if os.environ.get(READ_VARIABLE) else None
    if found is None or _place(found) != _place(url):
        return None
    return found.set(query={**url.query, **found.query})


def _place(url: URL) -> tuple[object, ...]:
    return url.get_backend_name(), url.host, url.port or 5432, url.database


def file_url(path: Path) -> str:
    """Return the URL of a SQLite file, whatever its name."""
    return URL.create("sqlite", database=str(path.absolute())).render_as_string()


def public_url(url: URL) -> str:
    """Return the URL without passwords, and with letters in place of their codes."""
    public = {key: value for key, value in url.query.items() if key not in _SECRETS}
    text = url.set(query=public).render_as_string(hide_password=True)
    return _LETTERS.sub(lambda code: unquote(code[0]), text)


def sqlite_path(url: URL) -> Path:
    """Return the absolute path of a SQLite database, links resolved.

    The lock files are beside the file itself, so that two names of one database share them.
    """
    if url.database in (None, "", _IN_MEMORY):
        raise StoreError(
            "A SQLite database in memory cannot be shared between processes: "
            "give a file, such as sqlite:///results/results.db."
        )
    return Path(str(url.database)).resolve()


# A lock held for too long, or a race between processes that open the file.
_TRANSIENT_SQLITE = ("SQLITE_BUSY", "SQLITE_LOCKED", "SQLITE_PROTOCOL")

# Classes and codes of the SQL standard and of PostgreSQL's appendix A.
_TRANSIENT_STATES = (
    "08",  # connection lost or refused
    "40",  # deadlock, serialization failure: the transaction was the victim, not the cause
    "53200",  # out of memory
    "53300",  # too many connections
    "55P03",  # lock not available
    "57014",  # cancelled, as by a statement timeout
    "57P01",  # shutting down
    "57P02",  # crashed
    "57P03",  # starting up
    "57P05",  # an idle session was ended
    "25P03",  # an idle transaction was ended
)

# During a connection attempt the driver has no code; only the text of the server distinguishes a
# permanent refusal from a temporary one.
_TEMPORARY_REFUSALS = (
    "starting up",
    "shutting down",
    "recovery mode",
    "not yet accepting connections",
    "too many clients",
    "too many connections",
    "connection slots are reserved",
    "terminating connection",
)
_UNKNOWN_PLACE = ("failed to resolve host", "could not translate host name", "invalid port number")


def is_transient(error: BaseException | None, known_host: bool) -> bool:
    """Return whether the same request may succeed later without any intervention.

    ``known_host`` is True if the server has answered before: its name is valid then, and may be
    unresolvable only for a while, such as during the restart of a container.
    """
    name = getattr(error, "sqlite_errorname", None)
    if name is not None:
        return str(name).startswith(_TRANSIENT_SQLITE)
    state, text = getattr(error, "sqlstate", None), str(error)
    if state is not None:
        return str(state).startswith(_TRANSIENT_STATES)
    if type(error).__module__.partition(".")[0] != "psycopg":
        return False
    if any(words in text for words in _UNKNOWN_PLACE):
        return known_host
    return "FATAL:" not in text or any(words in text for words in _TEMPORARY_REFUSALS)


_SQLITE = {
    "SQLITE_BUSY": "another process has locked it for too long; find the process that has it open",
    "SQLITE_CANTOPEN": "the file cannot be opened; check that its folder exists and is writable",
    "SQLITE_CONSTRAINT": "its tables contradict each other, as after a deletion by hand; restore a "
    "copy, or give another path",
    "SQLITE_CORRUPT": "the file is damaged; restore a copy, or move it away and run again",
    "SQLITE_FULL": "the disk is full; make room and run the same command again",
    "SQLITE_IOERR": "reading or writing the disk failed; check the disk and run again",
    "SQLITE_NOTADB": "the file is not a SQLite database any more; restore a copy, or move it away "
    "and run again",
    "SQLITE_READONLY": "the file is read-only; make it writable or give another path",
}
_STATES = {
    "23": "its tables contradict each other, as after a deletion by hand; restore a backup",
    "28": "the server rejects this user; check the name and the password",
    "2B": "another view depends on a view of this program; drop it and create it again later",
    "3F": "its schema does not exist; create it or correct the search path",
    "42501": "the user lacks a permission; request the right to create and write tables",
    "25006": "the server is read-only, as a standby is; give the address of its primary",
    "53100": "the server's disk is full; make room and run the same command again",
    "58": "reading or writing the server's disk failed; check it and run again",
    "XX": "the server found damaged data; restore a backup",
}
_WRONG_PLACE = (
    errno.EACCES,
    errno.EEXIST,
    errno.ELOOP,
    errno.ENAMETOOLONG,
    errno.ENOENT,
    errno.ENOTDIR,
    errno.EPERM,
)
_SYNTAX = "42601"  # also of what is no SELECT, as a cursor is declared for it
_OUT_OF_TIME = ("SQLITE_INTERRUPT", "57014")
_NOT_OF_THE_QUERY = (*(name for name in _SQLITE if name != "SQLITE_READONLY"), "08", "53", "57P")
# Names instead of classes, so that a driver that is not installed is not imported.
_DRIVERS = ("sqlite3", "psycopg")
_KINDS = ("OperationalError", "InterfaceError", "InternalError", "IntegrityError")
_NOT_YET_ALLOWED = ("42501", "3F000")
_REFUSED = "its server refuses the connection; see the reason in brackets"
_ELSEWHERE = "check that its server runs and answers, then run the same command again"


@contextmanager
def translated(safe_url: str, known_host: bool = False, opening: bool = False) -> Iterator[None]:
    """Raise ``StoreUnavailableError`` for errors of the database, not of the program.

    ``known_host`` is True if the server has answered this process before. While a database is
    opened, ``opening``, a file of something else is the mistake of whoever has named it: a
    ``SchemaVersionError`` is raised. Errors are wrapped by SQLAlchemy, or raised directly by the
    driver in COPY and in backups.
    """
    try:
        yield
    except Exception as error:
        original = error.orig if isinstance(error, DBAPIError) else error
        if original is None or not _is_infrastructure(original):
            raise
        if opening and _code(original) == "SQLITE_NOTADB":
            raise SchemaVersionError(
                f"{safe_url} is not a SQLite database, but a results database of this program is "
                "expected: give the URL of another one, or of a new one, or restore a copy if it "
                "was one."
            ) from error
        raise StoreUnavailableError(
            f"The results database {safe_url} cannot be used: {_advice(original)} "
            f"({_first_line(original)}).",
            transient=is_transient(original, known_host),
        ) from error


@contextmanager
def translated_file(safe_url: str) -> Iterator[None]:
    """Raise ``StoreUnavailableError`` if a file beside the database cannot be used.

    If no such file can ever be created, the URL is wrong: a ``StoreError`` is raised.
    """
    try:
        yield
    except OSError as error:
        kind = StoreError if error.errno in _WRONG_PLACE else StoreUnavailableError
        raise kind(
            f"The results database {safe_url} needs {error.filename or 'files beside it'}, which "
            f"cannot be made or opened ({error.strerror}): make its folder writable, make room, "
            "or give another path."
        ) from error


@contextmanager
def translated_query(safe_url: str, seconds: float | None = None) -> Iterator[None]:
    """Raise ``QueryError`` for an SQL query of the user that the database rejects.

    ``seconds`` is its time limit.
    """
    with translated(safe_url):
        try:
            yield
        except DBAPIError as error:
            code = _code(error.orig)
            if code in _OUT_OF_TIME:
                raise out_of_time(seconds) from error
            if code.startswith(_NOT_OF_THE_QUERY) or (not code and _is_infrastructure(error.orig)):
                raise
            refused = code == "SQLITE_AUTH"
            reason = "only a SELECT is allowed" if refused else _first_line(error.orig)
            hint = ": give one SELECT" if code == _SYNTAX else ""
            raise QueryError(f"The query failed on {safe_url}: {reason}{hint}.") from error


def out_of_time(seconds: float | None) -> QueryError:
    """Return the error of a query that was ended after ``seconds``."""
    return QueryError(
        f"The query took longer than {seconds or 0:g} s and was cancelled: make it smaller, or "
        "run it by python -m orchestrate query with a larger --timeout."
    )


def is_of_driver(error: BaseException) -> bool:
    """Return whether a database driver raised the error."""
    return any(base.__module__.partition(".")[0] in _DRIVERS for base in type(error).__mro__)


def _code(original: BaseException | None) -> str:
    name = getattr(original, "sqlite_errorname", None)
    return str(name or getattr(original, "sqlstate", None) or "")


def _is_infrastructure(original: BaseException | None) -> bool:
    if getattr(original, "sqlstate", None) in _NOT_YET_ALLOWED:
        return True
    # sqlite3 raises the base class itself only for a damaged file.
    return type(original) is sqlite3.DatabaseError or any(
        base.__name__ in _KINDS and base.__module__.partition(".")[0] in _DRIVERS
        for base in type(original).__mro__
    )


def _advice(original: BaseException) -> str:
    name, state = (getattr(original, one, None) for one in ("sqlite_errorname", "sqlstate"))
    if name is not None:
        primary = "_".join(name.split("_")[:2])  # SQLITE_IOERR_WRITE -> SQLITE_IOERR
        return _SQLITE.get(primary, "SQLite refused; see the reason in brackets")
    if state is None:
        return _REFUSED if "FATAL:" in str(original) else _ELSEWHERE
    return next((text for code, text in _STATES.items() if state.startswith(code)), _ELSEWHERE)


def _first_line(original: BaseException | None) -> str:
    lines = str(original).strip().splitlines()
    return (lines[0] if lines else type(original).__name__).rstrip(".")


ANNOUNCE_SECONDS = 2.0
"""Wait for a lock of another process after which a warning says who holds it."""

log = logging.getLogger("dopt.store")

# The operation on a broken connection raises an error; the pool would add a traceback.
logging.getLogger("sqlalchemy.pool").setLevel(logging.CRITICAL)


@dataclass(frozen=True)
class LaunchLife:
    """Token and lease of a launch, which decide whether it is alive."""

    launch_id: int
    token: str
    lease_until: float | None


class NewTrial(NamedTuple):
    """Trial that is registered: nothing of it has run."""

    trial_key: str
    config_id: int
    seed: int


class Backend(ABC):
    """Writable database; methods with a connection run in its transaction."""

    def __init__(self, engine: Engine, safe_url: str) -> None:
        self.engine = engine
        self.safe_url = safe_url
        self._has_answered = False

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        """Run the block in one writing transaction."""
        opening = not self._has_answered
        errors = translated(self.safe_url, known_host=not opening, opening=opening)
        with errors, self.engine.begin() as connection:
            self._has_answered = True
            yield connection

    def check(self) -> None:  # noqa: B027  a server has no file that can be moved
        """Raise ``DatabaseMovedError`` if the URL names another file than the opened one.

        What the opened one holds is then saved in another file.
        """

    @abstractmethod
    def creation(self) -> AbstractContextManager[Connection]:
        """Open a transaction that only one process can hold at a time."""

    @abstractmethod
    def back_up(self, connection: Connection, version: int) -> str:
        """Copy the database of the given version to a new file and return its path."""

    def exclusive(self, connection: Connection) -> None:  # noqa: B027  one writer is alone
        """Keep other launches from registering or recovering until the transaction ends."""

    @abstractmethod
    def members(self, keys: Sequence[str]) -> Select[Any]:
        """Return the keys as a one-column query, for ``IN``; any number of them."""

    @abstractmethod
    def insert_trials(
        self, connection: Connection, trials: Sequence[NewTrial], launch_id: int
    ) -> None:
        """Write pending trials of a launch, of which none is in the database."""

    @abstractmethod
    def insert_steps(
        self, connection: Connection, trial_id: int, values: Array, first: int = 0
    ) -> None:
        """Write steps of a trial from t = ``first`` on, (T, number of STEP_VALUES).

        NaN becomes NULL.
        """

    def hold(self, token: str) -> None:  # noqa: B027  a lease is a column of the launch
        """Lock what says that a new launch is alive, before others can see it."""

    def renew(self, connection: Connection, launch_id: int) -> None:  # noqa: B027  a lock has none
        """Extend the lease of the launch."""

    @abstractmethod
    def dead(self, connection: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:
        """Return the launches whose process is gone."""

    def token(self) -> str:
        """Return a unique name for a launch of this process."""
        return uuid.uuid4().hex

    def evict(self) -> None:  # noqa: B027  the kernel releases the locks of a dead process
        """End the transactions of dead launches, which could keep their locks forever."""

    def forget(self, token: str) -> None:  # noqa: B027  a lease expires by itself
        """Delete the lock of a launch that has ended or died."""

    @abstractmethod
    def close(self) -> None:
        """Close connections and locks; launches that did not end count as dead."""


PROGRAM = "pg_dump"

_NOT_WRITTEN = tuple(f"{PROGRAM}: error: could not {verb} " for verb in ("open", "write", "close"))


def back_up_to(base: str, suffix: str, write: Callable[[Path], None]) -> str:
    """Let ``write`` make a file, give it a name that is free, and return that.

    The file gets its name when it is complete; an existing file is never replaced.
    """
    target = _free_name(base, suffix)
    partial = target.with_name(f"{target.name}.partial")
    try:
        write(partial)
        partial.rename(target)
    except OSError as error:
        raise StoreUnavailableError(
            f"The backup {target} cannot be made ({error.strerror or error}): make room or its "
            "folder writable, or make a copy yourself and give --no-backup."
        ) from error
    finally:
        partial.unlink(missing_ok=True)
    return str(target)


def rescue(opened: sqlite3.Connection, path: Path, before: Path | None) -> Path:
    """Copy what an open connection sees to a file beside the path that the database had.

    Where that cannot be written, the copy is made in the temporary folder. It replaces the file
    that was saved before. Raises ``OSError``, ``sqlite3.Error`` or ``StoreUnavailableError`` if
    neither can be written.
    """
    for place in (path, Path(tempfile.gettempdir()) / path.name):
        target = before or _free_name(f"{place}.saved-{os.getpid()}", ".db")
        partial = target.with_name(f"{target.name}.partial")
        try:
            _copy_from(opened, partial, path)
            partial.rename(target)
            return target
        except (OSError, sqlite3.Error, StoreUnavailableError) as error:
            failed = error
            with contextlib.suppress(OSError):
                partial.unlink()
    raise failed


_OF_THE_COPY = {
    "SQLITE_FULL": errno.ENOSPC,
    "SQLITE_READONLY": errno.EROFS,
    "SQLITE_CANTOPEN": errno.EACCES,
    "SQLITE_IOERR_WRITE": errno.EIO,
}
"""Errors of a copy whose source is opened to be read alone."""


def _free_name(base: str, suffix: str) -> Path:
    names = chain([f"{base}{suffix}"], (f"{base}-{i}{suffix}" for i in count(2)))
    return next(path for path in map(Path, names) if not path.exists())


def copy_checked(path: Path, partial: Path) -> None:
    """Copy a SQLite database with its log to one file, and check it.

    Raises
    ------
    OSError
        If the copy cannot be written.
    """
    with contextlib.closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as source:
        source.execute("PRAGMA schema_version").fetchone()  # the source can be opened
        _copy_from(source, partial, path)


def _copy_from(source: sqlite3.Connection, partial: Path, path: Path) -> None:
    partial.unlink(missing_ok=True)
    try:
        with contextlib.closing(sqlite3.connect(partial)) as copy:
            source.backup(copy)
            copy.execute("PRAGMA journal_mode = DELETE")  # one file, complete in itself
            (verdict,) = copy.execute("PRAGMA quick_check(1)").fetchone()
    except sqlite3.OperationalError as error:
        code = _OF_THE_COPY.get(error.sqlite_errorname)
        if code is None:
            raise
        raise OSError(code, os.strerror(code), str(partial)) from error
    if verdict != "ok":
        raise StoreUnavailableError(
            f"The results database {path} is damaged ({verdict}): nothing was changed; restore a "
            "copy of it."
        )
    descriptor = os.open(partial, os.O_RDONLY)
    os.fsync(descriptor)
    os.close(descriptor)


def dump(url: URL, schema: str, partial: Path, otherwise: str = "") -> None:
    """Write tables and views of a PostgreSQL schema to an archive for ``pg_restore``.

    The password is in the environment of ``pg_dump``, where other users cannot read it.
    ``otherwise`` ends the advice where the program is missing or older than the server.

    Raises
    ------
    OSError
        If the file cannot be written.
    StoreError
        If ``pg_dump`` is missing or older than the server.
    StoreUnavailableError
        If the database cannot be read.
    """
    address = url.set(drivername="postgresql")._replace(password=None)
    words = [PROGRAM, "--format=custom", f"--schema={schema}", f"--file={partial}"]
    words += ["--dbname", address.render_as_string(hide_password=False)]
    secret = {} if url.password is None else {"PGPASSWORD": str(url.password)}
    try:
        environment = {**os.environ, **secret, "LC_ALL": "C"}
        done = subprocess.run(words, env=environment, capture_output=True, text=True)
    except FileNotFoundError as error:
        raise StoreError(
            f"A backup of PostgreSQL needs the program {PROGRAM}, which is not installed: install "
            "the client programs of PostgreSQL, such as the Debian package "
            f"postgresql-client{otherwise}."
        ) from error
    reason, *details = done.stderr.strip().splitlines() or ["it gave no reason"]
    if "server version mismatch" in reason:
        versions = "; ".join(details).removeprefix(f"{PROGRAM}: detail: ")
        raise StoreError(
            f"{PROGRAM} is older than the server of {public_url(url)} ({versions}): install "
            f"the client programs of the server's version{otherwise}."
        )
    if reason.startswith(_NOT_WRITTEN):
        raise OSError(reason.rstrip("."))
    if done.returncode:
        raise StoreUnavailableError(
            f"{PROGRAM} has not backed up {public_url(url)}: {reason.rstrip('.')}."
        )
