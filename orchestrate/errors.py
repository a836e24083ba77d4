"""Errors of launches, databases and outputs, exit codes, redaction of passwords, whole files.

Each message is one sentence with a remedy. A password may be part of a URL, of its query, or of a
variable such as ``PGPASSWORD``. It is recognised by its position; passwords of the command line and
the environment are also replaced wherever they occur, such as in the message of an exception.
"""

from __future__ import annotations

import enum
import errno
import os
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import unquote, unquote_plus

from dopt.errors import DoptError


class ExitCode(enum.IntEnum):
    """Exit codes of the programs."""

    DONE = 0
    SOME_FAILED = 1
    BAD_REQUEST = 2
    UNFINISHED = 3  # trials are left, for which another worker may be started
    DEFECT = 70  # a bug of the program, with a traceback
    INFRASTRUCTURE = 75
    INTERRUPTED = 130


class LaunchError(DoptError, ValueError):
    """Invalid setting of a launch; nothing was run."""


class InfrastructureError(DoptError):
    """Loss of a service such as Ray; the same command continues later."""


class StoreError(DoptError):
    """Base of all errors of the results database."""


class StoreUnavailableError(StoreError, InfrastructureError):
    """Database that cannot be reached, or is full, locked or damaged.

    ``transient`` is True if waiting may help: after a lost server or connection, or a lock that was
    held for too long.
    """

    def __init__(self, message: str, *, transient: bool = False) -> None:
        super().__init__(message)
        self.transient = transient


class DatabaseMovedError(StoreUnavailableError):
    """Database file that was removed, renamed or replaced after it was opened."""


class NoDatabaseError(StoreError):
    """No database at the given URL."""


class SchemaVersionError(StoreError):
    """Database of an older or a newer version of the program, or of something else."""


class LaunchAliveError(StoreError):
    """Running launch in a database that must not change."""


class InvalidResultError(StoreError, ValueError):
    """Result of a trial with wrong shapes or contradictory values; nothing was written."""


class QueryError(StoreError, ValueError):
    """Query that the database cannot answer: unknown column, invalid SQL, missing trial."""


class OutputError(DoptError):
    """File or folder that cannot be written, such as on a full disk."""


HIDDEN = "***"

MIN_SECRET_LENGTH = 4
"""Shorter words are not replaced, because they occur in ordinary text."""

_NAMES = r"(?:password|passwd|passfile|secret|token)"
_SECRET_VARIABLE = re.compile(r"PASSW(OR)?D|SECRET|TOKEN$", re.IGNORECASE)

# In one argument the password extends to the last @, spaces included.
_WORD_QUERY = re.compile(rf"({_NAMES}=)([^&]*)", re.IGNORECASE)
_WORD_URL = re.compile(r"(://[^:/@]*:)(.*)@", re.DOTALL)
_TEXT_QUERY = re.compile(rf"({_NAMES}=)([^&\s'\"]+)", re.IGNORECASE)
_TEXT_URL = re.compile(r"(://[^:/@\s]*:)(\S*)@")


def without_password(text: str) -> str:
    """Return a text with all passwords replaced."""
    for secret in known_secrets([*sys.argv, *_environment()]):
        text = text.replace(secret, HIDDEN)
    return _TEXT_URL.sub(rf"\1{HIDDEN}@", _TEXT_QUERY.sub(rf"\1{HIDDEN}", text))


def without_password_in_word(word: str) -> str:
    """Return a command-line argument with the passwords of URLs replaced."""
    return _WORD_URL.sub(rf"\1{HIDDEN}@", _WORD_QUERY.sub(rf"\1{HIDDEN}", word))


def known_secrets(words: Iterable[str]) -> list[str]:
    """Return the passwords in the words, as written and URL-decoded, the longest first."""
    written = {match[2] for word in words for match in _matches(word)}
    meant = {form(secret) for secret in written for form in (str, unquote, unquote_plus)}
    return sorted(
        (secret for secret in meant if len(secret) >= MIN_SECRET_LENGTH), key=len, reverse=True
    )


def _matches(word: str) -> Iterator[re.Match[str]]:
    yield from _WORD_QUERY.finditer(word)
    yield from _WORD_URL.finditer(_WORD_QUERY.sub(r"\1", word))


def _environment() -> Iterator[str]:
    """Yield the variables that are secret by their name, and those that hold a URL."""
    for name, value in os.environ.items():
        if _SECRET_VARIABLE.search(name):
            yield f"password={value}"
        elif "://" in value:
            yield value


_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


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
