"""Results database: SQLite or PostgreSQL behind one interface.

:class:`Store` is the write side, used by launches; :class:`Reader` is the read side, used by the
analysis. A trial is registered, claimed by one launch, and committed completely or rejected.
"""

from __future__ import annotations

from orchestrate.records import Failure, RunRecord
from orchestrate.store.backends.open import LEASE_SECONDS
from orchestrate.store.backup import back_up
from orchestrate.store.database_url import DEFAULT_URL, READ_VARIABLE, URL_VARIABLE, default_url
from orchestrate.store.doctor.examine import examine
from orchestrate.store.doctor.findings import Finding
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
from orchestrate.store.merging.merge import Merged, TrialName, merge
from orchestrate.store.migrations.upgrade import Upgrade, upgrade
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
from orchestrate.store.shards import collect, merge_collected
from orchestrate.store.store import Store
from orchestrate.store.vacuum import Vacuumed, vacuum
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
    "Finding",
    "InvalidResultError",
    "LaunchAliveError",
    "LaunchRecord",
    "LaunchRow",
    "Merged",
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
    "TrialName",
    "TrialRow",
    "Upgrade",
    "Vacuumed",
    "back_up",
    "collect",
    "default_url",
    "examine",
    "explorations",
    "failure_kinds",
    "merge",
    "merge_collected",
    "prunable",
    "upgrade",
    "vacuum",
]
