"""Tables of the results database: one definition for SQLite (STRICT) and PostgreSQL.

Times are UTC text of fixed width (``2026-01-31T12:00:00.000000Z``) and flags are 0 or 1, so that
the same SQL gives the same result on both databases. A number that is not finite is NULL: SQLite
stores NaN as NULL, PostgreSQL as NaN.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, get_type_hints

from sqlalchemy import (
    REAL,
    BigInteger,
    CheckConstraint,
    Column,
    Double,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Select,
    Table,
    Text,
    UniqueConstraint,
    func,
    select,
)
from sqlalchemy.types import TypeEngine

SCHEMA_VERSION = 7
"""Number of the newest script in ``migrations/versions``."""

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
"""Pattern of the JSON of an exploration's configuration (:mod:`dopt.spec.prequential`)."""

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
    run, where the attribute has the name of the column.
    """

    kind: Any
    unit: str
    meaning: str
    of_run: bool = False


@dataclass(frozen=True)
class Outcome:
    """Columns of a trial that its outcome fills; None before.

    The table of trials and the views, what a launch writes, the rows of a reader, exports and
    bundles are made from these fields: a column is added here, with a migration.
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


def _one_of(column: str, values: tuple[str, ...]) -> CheckConstraint:
    listed = ", ".join(f"'{value}'" for value in values)
    return CheckConstraint(f"{column} IN ({listed})", name=f"{column}_is_known")


def _table(name: str, *items: Any, rowid: bool = True) -> Table:
    return Table(name, metadata, *items, sqlite_strict=True, sqlite_with_rowid=rowid)


def _text(name: str, nullable: bool = False) -> Column[str]:
    return Column(name, Text, nullable=nullable)


def _trial_key(**options: Any) -> Column[int]:
    return Column("trial_id", _Long, ForeignKey("trial.trial_id"), **options)


# As Alembic creates it, but STRICT, which has no VARCHAR.
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
    *(Column(name, column.kind) for name, column in OUTCOME.items()),
    Column("launch_id", _Long, ForeignKey("launch.launch_id")),  # launch of the outcome
    Column("error_id", _Long, ForeignKey("error.error_id")),
    Column("registered_by", _Long),  # launch_id of the code that may run it while it is pending
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

# Columns of ``step`` once more (:mod:`orchestrate.store.packed_curves`).
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
    *(Column(name, OUTCOME[name].kind) for name in RUN_COLUMNS if name != "node"),
    Column("error_id", _Long, ForeignKey("error.error_id")),
    Index("attempt_by_end", "ended"),
    rowid=False,
)


def alike(launch_id: int) -> Select[tuple[int]]:
    """Return the launches with the fingerprint of this one, as a one-column query for ``IN``."""
    mine = select(func.coalesce(launch.c.fingerprint, "")).where(launch.c.launch_id == launch_id)
    same = func.coalesce(launch.c.fingerprint, "") == mine.scalar_subquery()
    return select(launch.c.launch_id).where(same)
