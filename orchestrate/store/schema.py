"""Tables of the results database: one definition for SQLite (STRICT) and PostgreSQL.

Times are UTC text of fixed width (``2026-01-31T12:00:00.000000Z``) and flags are 0 or 1, so that
the same SQL gives the same result on both databases. A number that is not finite is NULL: SQLite
stores NaN as NULL, PostgreSQL as NaN.
"""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, get_type_hints

from sqlalchemy import (
    REAL,
    BigInteger,
    CheckConstraint,
    Column,
    Connection,
    Double,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Table,
    Text,
    UniqueConstraint,
    inspect,
    text,
)
from sqlalchemy.types import TypeEngine

from orchestrate.errors import SchemaVersionError

SCHEMA_VERSION = 7
"""Number of the newest schema, the last of :data:`orchestrate.store.maintenance.STATEMENTS`."""

LOCK_TABLE = "store_lock"
"""Empty table on PostgreSQL whose lock keeps other launches from registering or recovering."""

STATUSES = ("pending", "running", "done", "diverged", "failed", "cancelled")
FINISHED = ("done", "diverged")
"""Statuses of a trial that has a result."""

ENDED = (*FINISHED, "failed", "cancelled")
"""Statuses of a trial that has an outcome."""

LAUNCH_STATES = ("running", "done", "failed", "interrupted", "lost")
CONFIG_COLUMNS = (
    "env",
    "policy",
    "model",
    "learner",
    "width",
    "depth",
    "horizon",
    "dt",
    "gamma",
    "label",
)
RETRIED = {
    "failed": ("failed",),
    "diverged": ("diverged",),
    "cancelled": ("cancelled",),
    "all": ("failed", "diverged", "cancelled"),
}
"""Statuses that each argument of ``retry`` selects."""

PREQUENTIAL = '%"loss":"prequential"%'
"""Pattern of the JSON of an exploration's configuration (:mod:`dopt.spec.trial`)."""

N_ROWS = (
    f"CASE WHEN c.config_json LIKE '{PREQUENTIAL}' AND r.status = 'done' "
    "THEN coalesce(r.n_steps, 0) ELSE c.horizon END"
)
"""SQL of the number of steps that are stored of a finished trial r of a configuration c."""

_LOSS = "unit of the accelerations"

STEP_VALUES = ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us")

# STRICT tables know five type names; INTEGER is 64 bits wide in SQLite already.
_Real: TypeEngine[float] = Double().with_variant(REAL(), "sqlite")
_Long: TypeEngine[int] = BigInteger().with_variant(Integer(), "sqlite")


class OutcomeColumn(NamedTuple):
    """Type in SQL, unit and meaning of a column.

    A launch takes its value from the result of the trial or, ``of_run``, from the record of its
    run, where the attribute has the name of the column. ``since`` is the version of the schema
    that added it: it stands at the end of its table then, as in an upgraded database.
    """

    kind: Any
    unit: str
    meaning: str
    of_run: bool = False
    since: int = 0


@dataclass(frozen=True)
class Outcome:
    """Columns of a trial that its outcome fills; None before.

    The table of trials and the views, what a launch writes, the rows of a reader and exports
    are made from these fields, by their names: a column is added here, with statements
    in :data:`orchestrate.store.maintenance.STATEMENTS`.
    """

    n_steps: Annotated[
        int | None, OutcomeColumn(Integer, "steps", "steps before the end or the divergence")
    ]
    final_loss: Annotated[float | None, OutcomeColumn(_Real, _LOSS, "loss of the last step")]
    best_loss: Annotated[float | None, OutcomeColumn(_Real, _LOSS, "smallest loss of a step")]
    diverged_at: Annotated[
        int | None, OutcomeColumn(Integer, "step", "first step whose loss is not finite")
    ]
    wall_seconds: Annotated[float | None, OutcomeColumn(_Real, "s", "elapsed time", of_run=True)]
    cpu_seconds: Annotated[float | None, OutcomeColumn(_Real, "s", "processor time", of_run=True)]
    peak_memory_bytes: Annotated[
        int | None, OutcomeColumn(_Long, "byte", "largest memory of the process", of_run=True)
    ]
    node: Annotated[str | None, OutcomeColumn(Text, "", "host that ran the trial", of_run=True)]


OUTCOME: Mapping[str, OutcomeColumn] = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(Outcome, include_extras=True).items()
}
OUTCOME_COLUMNS = tuple(OUTCOME)
RUN_COLUMNS = tuple(name for name, column in OUTCOME.items() if column.of_run)
"""Columns of an outcome that an attempt has too."""

metadata = MetaData()


def _outcome(names: Iterable[str], *, added: bool = False) -> list[Column[Any]]:
    """Return columns of the outcome that a later schema has added, or the others."""
    chosen = sorted(names, key=lambda name: OUTCOME[name].since)
    return [
        Column(name, OUTCOME[name].kind) for name in chosen if added is (OUTCOME[name].since > 0)
    ]


def _one_of(column: str, values: tuple[str, ...]) -> CheckConstraint:
    listed = ", ".join(f"'{value}'" for value in values)
    return CheckConstraint(f"{column} IN ({listed})", name=f"{column}_is_known")


def _table(name: str, *items: Any, rowid: bool = True) -> Table:
    return Table(name, metadata, *items, sqlite_strict=True, sqlite_with_rowid=rowid)


def _text(name: str, nullable: bool = False) -> Column[str]:
    return Column(name, Text, nullable=nullable)


def _trial_key(**options: Any) -> Column[int]:
    return Column("trial_id", _Long, ForeignKey("trial.trial_id"), **options)


# The table and its name are of Alembic, which upgraded earlier schemas.
alembic_version = _table("alembic_version", Column("version_num", Text, primary_key=True))

launch = _table(
    "launch",
    Column("launch_id", _Long, primary_key=True),
    _text("token"),  # name of the lock file; launch_id repeats when a database is created again
    _text("state"),
    _text("started"),
    _text("ended", nullable=True),
    Column("lease_until", _Real),  # PostgreSQL only, seconds since 1970 on the server's clock
    _text("host"),
    Column("pid", Integer, nullable=False),
    _text("argv"),
    _text("overrides"),
    _text("git_commit", nullable=True),
    Column("git_dirty", Integer),
    _text("git_diff_hash", nullable=True),
    _text("versions"),
    Column("exit_code", Integer),
    _text("fingerprint", nullable=True),  # JSON; NULL of programs before schema 6
    _one_of("state", LAUNCH_STATES),
    Index("launch_by_token", "token", unique=True),
)

config = _table(
    "config",
    Column("config_id", _Long, primary_key=True),
    Column("config_key", Text, nullable=False, unique=True),
    _text("env"),
    _text("policy"),
    _text("model"),
    _text("learner"),
    Column("width", Integer),
    Column("depth", Integer),
    Column("horizon", Integer, nullable=False),
    Column("dt", _Real, nullable=False),
    Column("gamma", _Real, nullable=False),
    _text("config_json"),
    _text("label"),
)

error = _table(
    "error",
    Column("error_id", _Long, primary_key=True),
    Column("hash", Text, nullable=False, unique=True),
    _text("type"),
    _text("message"),
    _text("traceback"),
)

trial = _table(
    "trial",
    Column("trial_id", _Long, primary_key=True),
    Column("trial_key", Text, nullable=False, unique=True),
    Column("config_id", _Long, ForeignKey("config.config_id"), nullable=False),
    Column("seed", _Long, nullable=False),
    Column("status", Text, nullable=False),
    Column("owner", _Long, ForeignKey("launch.launch_id")),  # launch with the claim while running
    Column("attempt", Integer, nullable=False),
    *_outcome(OUTCOME),
    Column("launch_id", _Long, ForeignKey("launch.launch_id")),  # launch of the outcome
    Column("error_id", _Long, ForeignKey("error.error_id")),
    Column("registered_by", _Long),  # launch_id of the code that may run it while it is pending
    *_outcome(OUTCOME, added=True),
    _one_of("status", STATUSES),
    UniqueConstraint("config_id", "seed"),
    Index("trial_by_owner", "owner"),
    Index("trial_by_config_status", "config_id", "status"),
)

step = _table(
    "step",
    _trial_key(primary_key=True),
    Column("t", Integer, primary_key=True, autoincrement=False),
    *(Column(name, _Real) for name in STEP_VALUES),
    rowid=False,
)

# Columns of ``step`` once more (:mod:`orchestrate.store.records`).
curve = _table(
    "curve",
    _trial_key(primary_key=True, autoincrement=False),
    Column("attempt", Integer, nullable=False),
    *(Column(name, LargeBinary, nullable=False) for name in STEP_VALUES),
)

trajectory = _table(
    "trajectory",
    _trial_key(primary_key=True, autoincrement=False),
    _text("dtype"),
    _text("states_shape"),
    Column("states", LargeBinary, nullable=False),
    _text("inputs_shape"),
    Column("inputs", LargeBinary, nullable=False),
    _text("parameters_shape"),
    Column("parameters", LargeBinary, nullable=False),
)

assessment = _table(
    "assessment",
    _trial_key(primary_key=True),
    Column("t", Integer, primary_key=True, autoincrement=False),
    Column("measure", Text, primary_key=True),
    Column("value", _Real),
    rowid=False,
)

SAMPLE_LOSS = "sample_loss"
"""Measure of the table ``assessment`` that some trials of a configuration may have alone."""

attempt = _table(
    "attempt",
    _trial_key(primary_key=True),
    Column("attempt", Integer, primary_key=True, autoincrement=False),
    Column("launch_id", _Long, ForeignKey("launch.launch_id"), nullable=False),
    _text("outcome", nullable=True),  # NULL while it runs
    _text("cause", nullable=True),
    _text("node", nullable=True),
    Column("pid", Integer),
    _text("claimed"),
    _text("started", nullable=True),
    _text("ended", nullable=True),
    *_outcome(name for name in RUN_COLUMNS if name != "node"),
    Column("error_id", _Long, ForeignKey("error.error_id")),
    *_outcome(RUN_COLUMNS, added=True),
    Index("attempt_by_end", "ended"),
    rowid=False,
)


_CONFIG = "c.config_key, c.label, c.env, c.policy, c.model, c.learner, c.width, c.depth"

_OUTCOME = ", ".join(f"r.{name}" for name in OUTCOME_COLUMNS)

_TRIAL = f"""
SELECT {_CONFIG}, c.horizon, c.dt, c.gamma,
       r.seed, r.trial_id, r.trial_key, r.status, r.attempt, {_OUTCOME}, r.launch_id,
       e.type AS error_type, e.message AS error_message
FROM trial r
JOIN config c ON c.config_id = r.config_id
LEFT JOIN error e ON e.error_id = r.error_id
"""

# SQLite keeps the order of a CROSS JOIN: it would read the steps of all configurations otherwise.
_CURVE = f"""
SELECT {_CONFIG}, r.seed, s.t, s.loss, s.reachable_loss
FROM config c CROSS JOIN trial r CROSS JOIN step s
WHERE r.config_id = c.config_id AND s.trial_id = r.trial_id
"""

# One pass is exact enough: losses of different seeds differ by far more than 1e-6 of their mean,
# so cancellation in the variance costs less than 1e-3 of the error. The outer CASE keeps rounding
# from making the variance of equal losses negative. The square of a loss above 1e150 overflows,
# for which PostgreSQL refuses the whole query: such losses, of diverging models, have no error.
_CURVE_STATS = """
SELECT config_key, label, env, policy, model, learner, width, depth, t, n, n_finite, mean,
       CASE WHEN n_finite < 2 OR n_squares < n_finite THEN NULL
            WHEN squares <= n_finite * mean * mean THEN 0.0
            ELSE sqrt((squares - n_finite * mean * mean) / (n_finite - 1) / n_finite)
       END AS standard_error
FROM (SELECT config_key, label, env, policy, model, learner, width, depth, t,
             count(*) AS n, count(loss) AS n_finite, avg(loss) AS mean,
             count(CASE WHEN abs(loss) < 1e150 THEN 1 END) AS n_squares,
             sum(CASE WHEN abs(loss) < 1e150 THEN loss * loss END) AS squares
      FROM v_curve
      GROUP BY config_key, label, env, policy, model, learner, width, depth, t) AS sums
"""


_COUNTS = ",\n       ".join(
    f"count(*) FILTER (WHERE r.status = '{status}') AS n_{status}"
    for status in ("done", "diverged", "failed", "cancelled", "pending", "running")
)

_PROGRESS = f"""
SELECT {_CONFIG}, c.horizon, c.dt, c.gamma, count(*) AS n,
       {_COUNTS}
FROM config c
JOIN trial r ON r.config_id = c.config_id
GROUP BY c.config_id, {_CONFIG}, c.horizon, c.dt, c.gamma
"""

_FAILURES = f"""
SELECT {_CONFIG}, r.seed, r.trial_key, r.status, a.attempt, a.launch_id, a.node, a.ended,
       a.cause, e.type, e.message, e.traceback
FROM attempt a
JOIN error e ON e.error_id = a.error_id
JOIN trial r ON r.trial_id = a.trial_id
JOIN config c ON c.config_id = r.config_id
"""

_ASSESSMENT = f"""
SELECT {_CONFIG}, c.horizon, r.seed, r.trial_key, r.status, a.t, a.measure, a.value
FROM config c
JOIN trial r ON r.config_id = c.config_id
JOIN assessment a ON a.trial_id = r.trial_id
"""

# In the order of creation.
VIEWS = {
    "v_trial": _TRIAL,
    "v_curve": _CURVE,
    "v_curve_stats": _CURVE_STATS,
    "v_progress": _PROGRESS,
    "v_failures": _FAILURES,
    "v_assessment": _ASSESSMENT,
}


def create_views(connection: Connection) -> None:
    """Create the views, in place of those that an older program of this version has created."""
    if connection.dialect.name == "sqlite":
        drop_views(connection)
        create = "CREATE VIEW"
    else:
        create = "CREATE OR REPLACE VIEW"  # views of others may depend on them
    for name, query in VIEWS.items():
        connection.execute(text(f"{create} {name} AS {query}"))


def drop_views(connection: Connection) -> None:
    """Drop the views of this program, and no others."""
    existing = set(inspect(connection).get_view_names())
    for name in reversed(VIEWS):
        if name in existing:
            connection.execute(text(f"DROP VIEW {name}"))


OLDEST = 5
"""Oldest schema that is upgraded."""

CHECK_SECONDS = 10.0
"""Time that the check of a database may take, which a stranger may have made."""

_PROGRESS_STEPS = 10_000  # instructions of SQLite's virtual machine, well below a millisecond

# Of tables alone: a view may never end. Nor does a generated column hold what is in the file.
_COLUMNS = {
    "sqlite": "SELECT l.name, x.name, CASE x.hidden WHEN 0 THEN x.type END "
    "FROM pragma_table_list AS l, pragma_table_xinfo(l.name) AS x "
    "WHERE l.schema = 'main' AND l.type = 'table' AND l.strict = 1",
    "postgresql": "SELECT c.relname, a.attname, "
    "CASE a.attgenerated WHEN '' THEN upper(format_type(a.atttypid, NULL)) END "
    "FROM pg_class AS c JOIN pg_attribute AS a ON a.attrelid = c.oid WHERE c.relkind = 'r' "
    "AND c.relnamespace = to_regnamespace(current_schema()) AND a.attnum > 0 AND a.atttypid > 0",
}


def is_empty(connection: Connection) -> bool:
    return set(inspect(connection).get_table_names()) <= {LOCK_TABLE}


def create(connection: Connection) -> None:
    """Create the newest tables and views in an empty database."""
    metadata.create_all(connection, checkfirst=False)
    create_views(connection)
    stamp = alembic_version.insert().values(version_num=str(SCHEMA_VERSION))
    connection.execute(stamp)


def check(connection: Connection, safe_url: str) -> int:
    """Return the version of the schema; raise ``SchemaVersionError`` for another one.

    Raises it too if a table is a view, or has not the columns of this program.
    """
    with _limited(connection):
        version = _check_version(connection, safe_url)
        _check_tables(connection, safe_url)
    return version


@contextmanager
def _limited(connection: Connection) -> Iterator[None]:
    """End a statement of the block that takes too long."""
    if connection.dialect.name == "postgresql":
        connection.exec_driver_sql(f"SET LOCAL statement_timeout = {1000 * CHECK_SECONDS:.0f}")
        yield
        connection.exec_driver_sql("SET LOCAL statement_timeout = DEFAULT")
        return
    driver, end = connection.connection.driver_connection, time.monotonic() + CHECK_SECONDS
    driver.set_progress_handler(lambda: time.monotonic() > end, _PROGRESS_STEPS)  # type: ignore[union-attr]
    try:
        yield
    finally:
        driver.set_progress_handler(None, 0)  # type: ignore[union-attr]


def _check_tables(connection: Connection, safe_url: str) -> None:
    rows = connection.exec_driver_sql(_COLUMNS[connection.dialect.name])
    found = {(table, column): kind for table, column, kind in rows}
    generated = {table for (table, _), kind in found.items() if kind is None}
    tables = [one for one in metadata.sorted_tables if one is not alembic_version]
    for table in tables:
        kinds = {one.name: one.type.compile(connection.dialect) for one in table.columns}
        whole = all(found.get((table.name, name)) == kind for name, kind in kinds.items())
        if not whole or table.name in generated:
            raise SchemaVersionError(
                f"{safe_url} is not a results database of this program ({table.name} is no table, "
                "or has other columns): give the URL of another one, or of a new one."
            )


def _check_version(connection: Connection, safe_url: str) -> int:
    version = version_of(connection, safe_url)
    if version < SCHEMA_VERSION:
        command = f"python -m orchestrate upgrade --db {shlex.quote(safe_url)}"
        raise SchemaVersionError(
            f"The results database {safe_url} was written by an older program (its schema is "
            f"version {version}, this program reads version {SCHEMA_VERSION}): run '{command}', "
            "which makes a backup first."
        )
    check_not_newer(version, safe_url)
    return version


def check_not_newer(version: int, safe_url: str) -> None:
    if version > SCHEMA_VERSION:
        raise SchemaVersionError(
            f"The results database {safe_url} was written by a newer program (its schema is "
            f"version {version}, this program reads version {SCHEMA_VERSION}): update the program."
        )


def version_of(connection: Connection, safe_url: str) -> int:
    """Return the version of the schema; raise ``SchemaVersionError`` for others and old ones."""
    tables = inspect(connection).get_table_names()
    found = "1" if "schema_version" in tables else None  # before the program used Alembic
    if alembic_version.name in tables:
        found = connection.execute(text("SELECT max(version_num) FROM alembic_version")).scalar()
    if "trial" not in tables or not str(found).isdecimal():
        raise SchemaVersionError(
            f"{safe_url} is not a results database of this program (it has no table "
            f"'{alembic_version.name}' with the number of a schema): give the URL of another one, "
            "or of a new one."
        )
    version = int(str(found))
    if version < OLDEST:
        raise SchemaVersionError(
            f"The results database {safe_url} has schema {version}, but only schemas from {OLDEST} "
            "on are upgraded: export it with the release of this program that wrote it."
        )
    return version
