"""Results database: SQLite or PostgreSQL behind one interface.

:class:`Store` is the write side, used by launches; :class:`Reader` is the read side, used by the
analysis. A trial is registered, claimed by one launch, and committed completely or rejected.
What a command does to a whole database is in the modules ``merge`` and
``maintenance``.
"""

from __future__ import annotations

from orchestrate.errors import (
    DatabaseMovedError,
    InvalidResultError,
    LaunchAliveError,
    NoDatabaseError,
    QueryError,
    SchemaVersionError,
    StoreError,
    StoreUnavailableError,
)
from orchestrate.records import URL_VARIABLE, Failure, RunRecord
from orchestrate.store.backend import DEFAULT_URL, READ_VARIABLE, default_url
from orchestrate.store.launches import OpenConfig, OpenTrial
from orchestrate.store.reader import (
    ExplorationRow,
    FailureKind,
    Reader,
    TrialReport,
    explorations,
    failure_kinds,
    public,
    trial_report,
)
from orchestrate.store.records import (
    Assessments,
    Claim,
    ConfigRow,
    Curves,
    LaunchRecord,
    LaunchRow,
    Registration,
    Table,
    Trajectory,
    TrialRow,
)
from orchestrate.store.schema import CONFIG_COLUMNS, FINISHED, RETRIED
from orchestrate.store.store import LEASE_SECONDS, Saved, Store

__all__ = [
    "CONFIG_COLUMNS",
    "DEFAULT_URL",
    "FINISHED",
    "LEASE_SECONDS",
    "READ_VARIABLE",
    "RETRIED",
    "URL_VARIABLE",
    "Assessments",
    "Claim",
    "ConfigRow",
    "Curves",
    "DatabaseMovedError",
    "ExplorationRow",
    "Failure",
    "FailureKind",
    "InvalidResultError",
    "LaunchAliveError",
    "LaunchRecord",
    "LaunchRow",
    "NoDatabaseError",
    "OpenConfig",
    "OpenTrial",
    "QueryError",
    "Reader",
    "Registration",
    "RunRecord",
    "Saved",
    "SchemaVersionError",
    "Store",
    "StoreError",
    "StoreUnavailableError",
    "Table",
    "Trajectory",
    "TrialReport",
    "TrialRow",
    "default_url",
    "explorations",
    "failure_kinds",
    "public",
    "trial_report",
]
