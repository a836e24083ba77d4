"""Maintenance of databases: backup, upgrade, what can be pruned, and examination.

In an upgrade the check for running launches, the backup, the migration and the labels of
configurations are one exclusive transaction. The statements of a schema never change; what the
current program computes, the labels, is written after them.

An examination changes nothing. It says what is wrong, and what to do about it: damage to a SQLite
file, incomplete results, damaged arrays of packed curves, keys that do not match their content,
results of different code, and claims of dead launches.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from sqlalchemy import Connection, bindparam, select, text, update

from dopt.spec.config import REGISTRIES, config_label, section_class
from orchestrate.errors import NoDatabaseError, StoreError, StoreUnavailableError, whole
from orchestrate.store import launches, records, schema, sqlite
from orchestrate.store.backend import (
    Backend,
    copy_checked,
    dump,
    file_url,
    parse_url,
    public_url,
    translated,
    translated_file,
)
from orchestrate.store.merge import EXPECTED, Merged, merge
from orchestrate.store.reader import Reader
from orchestrate.store.schema import (
    ENDED,
    N_ROWS,
    PREQUENTIAL,
    SAMPLE_LOSS,
    SCHEMA_VERSION,
    STEP_VALUES,
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
    parsed = parse_url(url)
    with whole(target, "FILE") as partial:
        if parsed.get_backend_name() == "postgresql":
            with Reader.open(url) as reader:
                ((schema,),) = reader.rows("SELECT quote_ident(current_schema())")
            dump(parsed, schema, partial)
        else:
            with translated(public_url(parsed), opening=True):
                copy_checked(sqlite.existing_path(parsed), partial)
    return target.stat().st_size


def merge_folder(url: str, folder: Path) -> Merged:
    """Merge the SQLite files in a folder into a database, one after the other.

    Raises ``NoDatabaseError`` if it holds none, and as :func:`merge` does.
    """
    found = sorted(folder.glob("*.db"))
    if not found:
        raise NoDatabaseError(f"The folder {folder} holds no database (*.db): give another one.")
    total = Merged()
    for path in found:
        with tempfile.TemporaryDirectory() as local:
            copy = Path(local) / path.name
            with translated_file(str(path)):
                shutil.copyfile(path, copy)
            total.include(merge(url, file_url(copy)))
    return total


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


Severity = Literal["error", "note"]

_MAX_REPORTED = 20

_REBUILD = (
    "merge this database into a new one, which leaves such trials out (python -m orchestrate merge "
    "THIS --db NEW), and run the same launch into that one"
)
_RESTORE = (
    "restore a copy from before the damage; without one, save what can be read with "
    "sqlite3 DATABASE .recover, and run the same launch again"
)
_NEXT_LAUNCH = "nothing to do: the next launch releases them"
_ONE_CODE = (
    "compare their numbers with care, or prune the trials of one of the two (launch_id of v_trial) "
    "and give their launch command again"
)
_MISMATCH = "whose key does not match their content"
_PACK_AGAIN = "delete all rows of the table curve and run 'python -m orchestrate upgrade'"
_RUN_AGAIN = "they were changed: restore an older copy, or run them again in a new database"


@dataclass(frozen=True)
class Finding:
    """Result of a consistency check.

    Attributes
    ----------
    severity
        "error" if results cannot be trusted, "note" if nothing is lost.
    sentence
        Description.
    count
        Number of occurrences.
    advice
        Remedy.
    """

    severity: Severity
    sentence: str
    count: int
    advice: str


def examine(url: str) -> list[Finding]:
    """Return the findings of all checks, errors first; nothing is written.

    A changed bit within a number of a SQLite file cannot be detected. Raises ``StoreError`` as
    :meth:`Reader.open` does; damage to a file that can still be opened is a finding.
    """
    parsed = parse_url(url)
    is_file = parsed.get_backend_name() == "sqlite"
    findings: list[Finding] = []
    try:
        with Reader.open(url) as reader, reader.moment() as moment:
            for check in (*(_OF_FILES if is_file else ()), *_CHECKS):
                try:
                    findings += check(moment)
                except StoreUnavailableError as error:  # of a damaged page, or of a server
                    if not is_file or error.transient:
                        raise
                    findings.append(Finding("error", str(error).rstrip("."), 1, _RESTORE))
    except StoreUnavailableError:
        # After damage SQLite may not even end the transaction; the findings are kept.
        if not any(one.severity == "error" for one in findings):
            raise
    return sorted(dict.fromkeys(findings), key=lambda one: one.severity)


def _several(severity: Severity, what: str, names: Sequence[object], advice: str) -> list[Finding]:
    """Return a finding of several objects of a kind, with the name of the first; none of none."""
    if not names:
        return []
    sentence = f"{what}: {len(names):,} (the first is {names[0]})"
    return [Finding(severity, sentence, len(names), advice)]


def _damaged_pages(moment: Reader) -> list[Finding]:
    """Run SQLite's integrity check."""
    rows = moment.rows(f"PRAGMA integrity_check({_MAX_REPORTED})")
    lines = [" ".join(str(row[0]).split()) for row in rows]
    damaged = [] if lines == ["ok"] else lines
    return _several("error", "damaged places in the file, or more", damaged, _RESTORE)


def _dangling_references(moment: Reader) -> list[Finding]:
    """Run SQLite's foreign key check."""
    rows = moment.rows("PRAGMA foreign_key_check")
    if not rows:
        return []
    tables = ", ".join(sorted({str(row[0]) for row in rows}))
    sentence = f"rows that refer to missing rows: {len(rows):,}, in {tables}"
    return [Finding("error", sentence, len(rows), _REBUILD)]


def _damaged_curves(moment: Reader) -> list[Finding]:
    """Unpack every array of the packed curves."""
    damaged = [
        f"trial_id {trial_id}"
        for rows in moment.batches(
            1_000, f"SELECT trial_id, {', '.join(STEP_VALUES)} FROM curve ORDER BY trial_id"
        )
        for trial_id, *arrays in rows
        if any(not len(records.unpacked_curve(one)) for one in arrays)
    ]
    return _several("error", "trials with a packed curve that is damaged", damaged, _PACK_AGAIN)


def _wrong_keys(moment: Reader) -> list[Finding]:
    """Compare every key with a new hash."""
    rows = moment.rows("SELECT config_id, config_key, config_json FROM config ORDER BY config_id")
    texts = {config_id: text for config_id, _, text in rows}
    wrong = [key[:12] for _, key, text in rows if records.config_key(text) != key]
    findings = _several("error", f"configurations {_MISMATCH}", wrong, _RUN_AGAIN)
    trials = moment.batches(
        10_000, "SELECT config_id, seed, trial_key FROM trial ORDER BY trial_id"
    )
    wrong = [
        key[:12]
        for batch in trials
        for config_id, seed, key in batch
        if records.trial_key(texts[config_id], seed) != key
    ]
    return findings + _several("error", f"trials {_MISMATCH}", wrong, _RUN_AGAIN)


def _mixed_code(moment: Reader) -> list[Finding]:
    """Find the configurations whose finished trials were run by different code."""
    what = "configurations with results of code or libraries with different fingerprints"
    return _several("note", what, [key[:12] for key in moment.mixed_code()], _ONE_CODE)


def _dead_launches(moment: Reader) -> list[Finding]:
    """Find the launches that are recorded as running but are dead, and the trials they hold."""
    rows = moment.launches()
    dead = sorted(row.launch_id for row in rows if row.state == "running" and not row.alive)
    over = {row.launch_id for row in rows if row.state != "running"} | set(dead)
    owners = [row[0] for row in moment.rows("SELECT owner FROM trial WHERE status = 'running'")]
    held = sum(owner is None or owner in over for owner in owners)
    what = "launches recorded as running whose process is gone"
    findings = _several("note", what, [f"launch {one}" for one in dead], _NEXT_LAUNCH)
    if held:
        what = f"trials held by launches that do not run: {held:,}"
        findings.append(Finding("note", what, held, _NEXT_LAUNCH))
    return findings


_NAME = (
    "c.env || ' ' || c.policy || ' seed ' || r.seed || ' (' || substr(r.trial_key, 1, 12) || ')'"
)
_FINISHED = "r.status IN ('done', 'diverged')"
_END = f"coalesce(r.diverged_at, {N_ROWS})"  # the first step without a loss
_LARGEST = "1.7976931348623157e308"  # NaN is larger in PostgreSQL, and NULL in SQLite


def _not_finite(table: str, *columns: str) -> str:
    return " OR ".join(f"abs({table}.{column}) > {_LARGEST}" for column in columns)


_CONDITIONS = {
    "finished trials without one step for each t below their horizon": (
        f"{_FINISHED} AND (s.n IS NULL OR s.n <> {N_ROWS} OR s.low <> 0 OR s.high <> {N_ROWS} - 1)"
    ),
    "finished trials that lack a loss before they diverged or ended, or have one after that": (
        f"{_FINISHED} AND (s.n_loss <> {_END} OR s.last >= {_END})"
    ),
    "done trials whose final loss differs from the loss of their last step": (
        "r.status = 'done' AND (r.final_loss IS NULL OR r.final_loss <> e.loss)"
    ),
    "finished trials without a trajectory": f"{_FINISHED} AND p.trial_id IS NULL",
    "done trials that lack assessments": (
        f"r.status = 'done' AND c.config_json NOT LIKE '{PREQUENTIAL}' "
        "AND (coalesce(a.n, 0) <> coalesce(m.most, 0) "
        """OR (coalesce(a.n, 0) = 0 AND (c.config_json LIKE '%"task":{%' """
        """OR c.config_json LIKE '%"limits":{%')))"""
    ),
    "unfinished trials with steps, a trajectory or assessments": (
        f"NOT {_FINISHED} AND (s.n > 0 OR p.trial_id IS NOT NULL OR a.trial_id IS NOT NULL)"
    ),
    "trials with a number that is not finite, where NULL is expected": (
        f"s.infinite > 0 OR a.infinite > 0 OR {_not_finite('r', 'final_loss', 'best_loss')}"
    ),
}
_FLAGS = [
    f"CASE WHEN {condition} THEN 1 ELSE 0 END AS flag_{i}"
    for i, condition in enumerate(_CONDITIONS.values())
]
_SUM = " + ".join(f"flag_{i}" for i in range(len(_FLAGS)))
_STEPS = f"""
SELECT trial_id, count(*) AS n, min(t) AS low, max(t) AS high, count(loss) AS n_loss,
       max(CASE WHEN loss IS NOT NULL THEN t END) AS last,
       sum(CASE WHEN {_not_finite("s", *STEP_VALUES)} THEN 1 ELSE 0 END) AS infinite
FROM step s GROUP BY trial_id
"""
_ASSESSMENTS = f"""
SELECT trial_id, count(*) FILTER (WHERE measure <> '{SAMPLE_LOSS}') AS n,
       sum(CASE WHEN {_not_finite("a", "value")} THEN 1 ELSE 0 END) AS infinite
FROM assessment a GROUP BY trial_id
"""
_SQL = f"""
SELECT * FROM (
    SELECT r.trial_id, {_NAME} AS name, {", ".join(_FLAGS)}
    FROM trial r
    JOIN config c ON c.config_id = r.config_id
    LEFT JOIN ({_STEPS}) s ON s.trial_id = r.trial_id
    LEFT JOIN step e ON e.trial_id = r.trial_id AND e.t = {N_ROWS} - 1
    LEFT JOIN trajectory p ON p.trial_id = r.trial_id
    LEFT JOIN ({_ASSESSMENTS}) a ON a.trial_id = r.trial_id
    LEFT JOIN ({EXPECTED}) m ON m.config_id = r.config_id) AS flagged
WHERE {_SUM} > 0 ORDER BY trial_id
"""


def _incomplete_results(moment: Reader) -> list[Finding]:
    """Look for finished trials that lack rows, and for others that have some."""
    rows = moment.rows(_SQL)
    findings = []
    for column, condition in enumerate(_CONDITIONS, start=2):
        names = [row[1] for row in rows if row[column]]
        findings += _several("error", condition, names, _REBUILD)
    return findings


_OF_FILES = (_damaged_pages, _dangling_references)
_CHECKS = (_incomplete_results, _damaged_curves, _wrong_keys, _mixed_code, _dead_launches)
