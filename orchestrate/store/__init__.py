"""The results database: SQLite or PostgreSQL behind one contract.

:class:`Store` is the write side, used by launches; :class:`Reader` the read side, used by the
analysis. A trial is registered, claimed by one launch, and committed whole or refused.
"""

from __future__ import annotations

from orchestrate.store.errors import (
    InvalidResultError,
    NoDatabaseError,
    QueryError,
    SchemaVersionError,
    StoreError,
    StoreUnavailableError,
)
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
from orchestrate.store.rows import Cell, Curves, Table, Trajectory, TrialRow
from orchestrate.store.store import LEASE_SECONDS, Store

__all__ = [
    "LEASE_SECONDS",
    "Cell",
    "Claim",
    "Curves",
    "Failure",
    "InvalidResultError",
    "LaunchRecord",
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
]
