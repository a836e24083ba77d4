"""Results database: SQLite or PostgreSQL behind one interface.

:class:`Store` is the write side, used by launches; :class:`Reader` is the read side, used by the
analysis. A trial is registered, claimed by one launch, and committed completely or rejected.
What a command does to a whole database is in modules of their own: ``merging``, ``migrations``,
``doctor``, ``shards``, ``backup`` and ``vacuum``.
"""

from __future__ import annotations

from orchestrate.records import Failure, RunRecord
from orchestrate.store.backends.open import LEASE_SECONDS
from orchestrate.store.database_url import DEFAULT_URL, READ_VARIABLE, URL_VARIABLE, default_url
from orchestrate.store.errors import (
    DatabaseMovedError,
    InvalidResultError,
    LaunchAliveError,
    NoDatabaseError,
    QueryError,
    SchemaVersionError,
    StoreError,
    StoreUnavailableError,
)
from orchestrate.store.read.explorations import ExplorationRow, explorations
from orchestrate.store.read.failures import FailureKind, failure_kinds
from orchestrate.store.read.open_trials import OpenConfig, OpenTrial
from orchestrate.store.read.prunable import Prunable, prunable
from orchestrate.store.read.reader import Reader
from orchestrate.store.read.rows import (
    Assessments,
    ConfigRow,
    Curves,
    LaunchRow,
    Table,
    Trajectory,
    TrialRow,
)
from orchestrate.store.records import (
    Claim,
    LaunchRecord,
    Registrable,
    Registration,
    Result,
)
from orchestrate.store.schema import CONFIG_COLUMNS, FINISHED, RETRIED
from orchestrate.store.store import Store
from orchestrate.store.write.explorations import Saved

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
    "Prunable",
    "QueryError",
    "Reader",
    "Registrable",
    "Registration",
    "Result",
    "RunRecord",
    "Saved",
    "SchemaVersionError",
    "Store",
    "StoreError",
    "StoreUnavailableError",
    "Table",
    "Trajectory",
    "TrialRow",
    "default_url",
    "explorations",
    "failure_kinds",
    "prunable",
]
