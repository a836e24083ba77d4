"""The results database: SQLite or PostgreSQL behind one contract.

:class:`Store` is the write side, used by launches; :class:`Reader` the read side, used by the
analysis. A trial is registered, claimed by one launch, and committed whole or refused.
"""

from __future__ import annotations

from orchestrate.store.errors import (
    InvalidResultError,
    LaunchAliveError,
    NoDatabaseError,
    QueryError,
    SchemaVersionError,
    StoreError,
    StoreUnavailableError,
)
from orchestrate.store.examining import examine
from orchestrate.store.findings import Finding
from orchestrate.store.merging import Merged, Named, merge
from orchestrate.store.opening import LEASE_SECONDS
from orchestrate.store.reader import Reader
from orchestrate.store.records import (
    Claim,
    Failure,
    LaunchRecord,
    Registrable,
    Registration,
    Result,
    RunRecord,
)
from orchestrate.store.rows import Assessments, Cell, Curves, LaunchRow, Table, Trajectory, TrialRow
from orchestrate.store.schema import RETRIED
from orchestrate.store.store import Store
from orchestrate.store.upgrading import Upgrade, upgrade

__all__ = [
    "LEASE_SECONDS",
    "RETRIED",
    "Assessments",
    "Cell",
    "Claim",
    "Curves",
    "Failure",
    "Finding",
    "InvalidResultError",
    "LaunchAliveError",
    "LaunchRecord",
    "LaunchRow",
    "Merged",
    "Named",
    "NoDatabaseError",
    "QueryError",
    "Reader",
    "Registrable",
    "Registration",
    "Result",
    "RunRecord",
    "SchemaVersionError",
    "Store",
    "StoreError",
    "StoreUnavailableError",
    "Table",
    "Trajectory",
    "TrialRow",
    "Upgrade",
    "examine",
    "merge",
    "upgrade",
]
