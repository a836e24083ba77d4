"""Maintenance of databases: backup, upgrade, shared copies, and what can be pruned.

In an upgrade the check for running launches, the backup, the migration and the labels of
configurations are one exclusive transaction. The statements of a schema never change; what the
current program computes, the labels, is written after them.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from sqlalchemy import URL, Connection, bindparam, select, text, update

from dopt.spec.config import REGISTRIES, config_label, section_class
from orchestrate.errors import NoDatabaseError, StoreError
from orchestrate.files import whole
from orchestrate.store import launches, records, schema
from orchestrate.store.backends import sqlite
from orchestrate.store.backends.base import (
    Backend,
    copy_checked,
    dump,
    parse_url,
    public_url,
    sqlite_path,
    translated,
    translated_file,
)
from orchestrate.store.backends.sqlite_engine import existing_path
from orchestrate.store.doctor import TrialKey
from orchestrate.store.merge import Merged, merge
from orchestrate.store.reader import Reader
from orchestrate.store.schema import (
    ENDED,
    N_ROWS,
    SCHEMA_VERSION,
    alembic_version,
    config,
    create_views,
    curve,
    drop_views,
)
from orchestrate.store.store import make_backend


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
        _copy(parse_url(url), url, partial)
    return target.stat().st_size


def _copy(parsed: URL, url: str, partial: Path) -> None:
    if parsed.get_backend_name() == "postgresql":
        with Reader.open(url) as reader:
            ((schema,),) = reader.rows("SELECT quote_ident(current_schema())")
        dump(parsed, schema, partial)
        return
    with translated(public_url(parsed), opening=True):
        copy_checked(existing_path(parsed), partial)


SUFFIX = ".db"


def collect(url: str, folder: Path) -> None:
    """Copy a SQLite database, which launches may be writing, to a file of its name in a folder.

    Raises ``StoreUnavailableError`` if the folder has no room or fails, and ``StoreError`` if it
    can never be written; an older copy stays then.
    """
    path = sqlite_path(parse_url(url))
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


STATEMENTS = {
    6: (
        "ALTER TABLE launch ADD COLUMN fingerprint TEXT",
        "ALTER TABLE trial ADD COLUMN registered_by {whole}",
    ),
    7: ("DROP TABLE live_step",),
}
"""Statements that make each schema of the one before it.

``{whole}`` is a 64-bit integer and ``{real}`` a double, which the databases call by other names.
"""


@dataclass(frozen=True)
class Upgrade:
    """Result of an upgrade.

    Attributes
    ----------
    before, after
        Version of the schema; ``before`` is None if the database was empty.
    backup
        Path of the backup, a file beside a SQLite database or an archive of ``pg_dump`` in the
        current folder; None without a backup.
    packed
        Trials whose curve was packed.
    """

    safe_url: str
    before: int | None
    after: int
    backup: str | None
    packed: int = 0

    @property
    def changed(self) -> bool:
        return self.before != self.after


def upgrade(url: str, backup: bool = True) -> Upgrade:
    """Migrate a results database to the newest schema, and pack the curves that lack it.

    Raises
    ------
    NoDatabaseError
        If there is no file.
    SchemaVersionError
        If the database is not a results database, or its schema is newer or too old.
    LaunchAliveError
        If a launch is running in it.
    StoreError
        If ``pg_dump`` is missing or older than the server.
    StoreUnavailableError
        If the database fails; it is then unchanged.
    """
    parsed = parse_url(url)
    if parsed.get_backend_name() == "sqlite":
        sqlite.existing_path(parsed)
    backend = make_backend(parsed)
    try:
        done = _upgrade(backend, backup)
        return replace(done, packed=records.write_missing_curves(backend))
    finally:
        backend.close()


def _upgrade(backend: Backend, backup: bool) -> Upgrade:
    name = None
    try:
        with backend.creation() as connection:
            if schema.is_empty(connection):
                schema.create(connection)
                return Upgrade(backend.safe_url, None, SCHEMA_VERSION, None)
            before = schema.version_of(connection, backend.safe_url)
            schema.check_not_newer(before, backend.safe_url)
            if before < SCHEMA_VERSION:
                launches.refuse_living(connection, backend)
                name = backend.back_up(connection, before) if backup else None
                migrate(connection, before)
                curve.create(connection, checkfirst=True)
                _write_labels(connection)
            else:
                create_views(connection)
    except BaseException:
        if name is not None:
            Path(name).unlink(missing_ok=True)
        raise
    return Upgrade(backend.safe_url, before, SCHEMA_VERSION, name)


def _write_labels(connection: Connection) -> None:
    """Write the labels as this program makes them, of configurations whose classes are known."""
    columns = select(config.c.config_id, config.c.config_json, config.c.label)
    stored = [(row[0], json.loads(row[1]), row[2]) for row in connection.execute(columns)]
    rows = [
        {"id": config_id, "text": made}
        for config_id, document, label in stored
        if all(section_class(document, key) for key in REGISTRIES if document.get(key))
        and (made := config_label(document)) != label
    ]
    if rows:
        statement = update(config).where(config.c.config_id == bindparam("id"))
        connection.execute(statement.values(label=bindparam("text")), rows)


def migrate(connection: Connection, version: int) -> None:
    """Bring a database of a version to the newest schema, in the transaction of the caller.

    The views are dropped and created again: not every database can change a table below a view.
    """
    drop_views(connection)
    sqlite_names = connection.dialect.name == "sqlite"
    kinds = {
        "whole": "INTEGER" if sqlite_names else "BIGINT",
        "real": "REAL" if sqlite_names else "DOUBLE PRECISION",
    }
    for number in range(version + 1, SCHEMA_VERSION + 1):
        for statement in STATEMENTS[number]:
            connection.execute(text(statement.format(**kinds)))
    connection.execute(update(alembic_version).values(version_num=str(SCHEMA_VERSION)))
    create_views(connection)
