"""Maintenance of databases: backup, vacuum, copies in a shared folder, and what can be pruned."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import URL

from orchestrate.files import whole
from orchestrate.store import database_url, schema
from orchestrate.store.backends.backups import copy_checked, dump
from orchestrate.store.backends.base import Backend
from orchestrate.store.backends.driver_errors import translated, translated_file
from orchestrate.store.backends.open import make_backend
from orchestrate.store.backends.sqlite_engine import existing_path
from orchestrate.store.doctor import TrialKey
from orchestrate.store.errors import NoDatabaseError, StoreError
from orchestrate.store.launches import refuse_living
from orchestrate.store.merge import Merged, merge
from orchestrate.store.reader import Reader
from orchestrate.store.schema import ENDED, N_ROWS


def back_up(url: str, target: Path) -> int:
    """Write a consistent copy of a database to a new file and return its bytes.

    The copy of SQLite is a database file, checked and complete in itself; of PostgreSQL it is an
    archive for ``pg_restore`` with the tables and views of the schema. The file gets its name when
    it is complete. Raises ``StoreError`` if the file exists, ``OutputError`` if it cannot be
    written, ``SchemaVersionError`` if it is no database, and ``StoreUnavailableError`` if it
    cannot be read.
    """
    if target.exists():
        raise StoreError(f"The file {target} exists, a new one is expected: give another name.")
    with whole(target, "FILE") as partial:
        _copy(database_url.parse(url), url, partial)
    return target.stat().st_size


def _copy(parsed: URL, url: str, partial: Path) -> None:
    if parsed.get_backend_name() == "postgresql":
        with Reader.open(url) as reader:
            ((schema,),) = reader.rows("SELECT quote_ident(current_schema())")
        dump(parsed, schema, partial)
        return
    with translated(database_url.safe(parsed), opening=True):
        copy_checked(existing_path(parsed), partial)


@dataclass(frozen=True)
class Vacuumed:
    """Bytes of a database before and after."""

    safe_url: str
    before: int
    after: int


def vacuum(url: str) -> Vacuumed:
    """Give the space of deleted rows back: SQLite to the disk, PostgreSQL to later rows.

    SQLite writes the file again, for which as much space must be free on its disk, and lets nobody
    else write meanwhile; PostgreSQL works beside launches. Raises as :meth:`Reader.open` does, and
    ``LaunchAliveError`` if a launch is writing to a SQLite file.
    """
    before = _size(url)
    backend = make_backend(database_url.parse(url))
    try:
        _vacuum(backend)
    finally:
        backend.close()
    return Vacuumed(backend.safe_url, before, _size(url))


def _size(url: str) -> int:
    with Reader.open(url) as reader:
        return reader.size()


def _vacuum(backend: Backend) -> None:
    if backend.needs_rest:
        with backend.transaction() as connection:
            schema.check(connection, backend.safe_url)
            refuse_living(connection, backend)
    with translated(backend.safe_url):
        backend.vacuum()


SUFFIX = ".db"


def collect(url: str, folder: Path) -> None:
    """Copy a SQLite database, which launches may be writing, to a file of its name in a folder.

    Raises ``StoreUnavailableError`` if the folder has no room or fails, and ``StoreError`` if it
    can never be written; an older copy stays then.
    """
    path = database_url.sqlite_path(database_url.parse(url))
    partial = folder / f"{path.name}.{os.getpid()}.partial"
    with (
        translated_file(str(folder)),
        translated(url),
        tempfile.TemporaryDirectory(dir=path.parent) as local,
    ):
        copy = Path(local) / path.name
        copy_checked(path, copy)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            shutil.copyfile(copy, partial)
            with partial.open("rb") as written:
                os.fsync(written.fileno())
            partial.replace(folder / path.name)
        finally:
            partial.unlink(missing_ok=True)


def merge_collected(
    url: str, folder: Path, pattern: str = f"*{SUFFIX}", trial_key: TrialKey | None = None
) -> Iterator[Merged]:
    """Merge the copies in a folder into a database, one after the other.

    Raises ``NoDatabaseError`` if it holds none, and as :func:`merge` does.
    """
    found = sorted(folder.glob(pattern))
    if not found:
        raise NoDatabaseError(
            f"The folder {folder} holds no database ({pattern}): give one that launches with "
            "store=shards have written to."
        )
    for path in found:
        with tempfile.TemporaryDirectory() as local:
            copy = Path(local) / path.name
            with translated_file(str(path)):
                shutil.copyfile(path, copy)
            yield merge(url, f"sqlite:///{copy}", trial_key)


_TRIALS = f"""
SELECT r.trial_key, r.status, c.config_key, r.launch_id,
       CASE WHEN r.status IN ('done', 'diverged') THEN {N_ROWS} ELSE 0 END AS steps,
       (SELECT max(a.ended) FROM attempt a WHERE a.trial_id = r.trial_id) AS ended
FROM trial r JOIN config c ON c.config_id = r.config_id ORDER BY r.trial_id
"""


@dataclass(frozen=True)
class Prunable:
    """Trials that would be deleted.

    Attributes
    ----------
    keys
        Of the trials.
    statuses
        Number of them by status.
    steps
        Their rows of the table ``step``.
    size
        Bytes of the database that they take: its size by their share of all steps.
    left
        Selected trials that stay, as they have no outcome or belong to a running launch.
    """

    keys: list[str]
    statuses: dict[str, int]
    steps: int
    size: int
    left: int


def prunable(
    reader: Reader,
    configs: Collection[str],
    keys: Collection[str] | None = None,
    before: str | None = None,
) -> Prunable:
    """Return the trials of some configurations, by key, that a rule selects.

    ``keys`` restricts them to these trials, and ``before``, a time as text, to those whose last
    attempt ended before it.
    """
    alive = {one.launch_id for one in reader.launches() if one.alive}
    found, statuses = list[str](), dict[str, int]()
    steps = left = total = 0
    for row in reader.rows(_TRIALS):
        total += row.steps
        wanted = row.config_key in configs and (keys is None or row.trial_key in keys)
        if not wanted or (before is not None and not (row.ended and row.ended < before)):
            continue
        if row.status not in ENDED or row.launch_id in alive:
            left += 1
            continue
        found.append(row.trial_key)
        statuses[row.status] = statuses.get(row.status, 0) + 1
        steps += row.steps
    return Prunable(found, statuses, steps, round(reader.size() * steps / max(total, 1)), left)
