"""Results database: SQLite or PostgreSQL behind one interface.

:class:`Store` is the write side, used by launches; :class:`Reader` is the read side, used by the
analysis. A trial is registered, claimed by one launch, and committed completely or rejected.
What a command does to a whole database is in the modules ``merge`` and
``maintenance``.
"""

from __future__ import annotations

from orchestrate.errors import (
    DatabaseMovedError as DatabaseMovedError,
)
from orchestrate.errors import (
    InvalidResultError as InvalidResultError,
)
from orchestrate.errors import (
    LaunchAliveError as LaunchAliveError,
)
from orchestrate.errors import (
    NoDatabaseError as NoDatabaseError,
)
from orchestrate.errors import (
    QueryError as QueryError,
)
from orchestrate.errors import (
    SchemaVersionError as SchemaVersionError,
)
from orchestrate.errors import (
    StoreError as StoreError,
)
from orchestrate.errors import (
    StoreUnavailableError as StoreUnavailableError,
)
from orchestrate.records import (
    URL_VARIABLE as URL_VARIABLE,
)
from orchestrate.records import (
    Failure as Failure,
)
from orchestrate.records import (
    RunRecord as RunRecord,
)
from orchestrate.store.backend import (
    DEFAULT_URL as DEFAULT_URL,
)
from orchestrate.store.backend import (
    READ_VARIABLE as READ_VARIABLE,
)
from orchestrate.store.backend import (
    default_url as default_url,
)
from orchestrate.store.launches import OpenConfig as OpenConfig
from orchestrate.store.launches import OpenTrial as OpenTrial
from orchestrate.store.reader import (
    ExplorationRow as ExplorationRow,
)
from orchestrate.store.reader import (
    FailureKind as FailureKind,
)
from orchestrate.store.reader import (
    Reader as Reader,
)
from orchestrate.store.reader import (
    TrialReport as TrialReport,
)
from orchestrate.store.reader import (
    explorations as explorations,
)
from orchestrate.store.reader import (
    failure_kinds as failure_kinds,
)
from orchestrate.store.reader import (
    public as public,
)
from orchestrate.store.reader import (
    trial_report as trial_report,
)
from orchestrate.store.records import (
    Assessments as Assessments,
)
from orchestrate.store.records import (
    Claim as Claim,
)
from orchestrate.store.records import (
    ConfigRow as ConfigRow,
)
from orchestrate.store.records import (
    Curves as Curves,
)
from orchestrate.store.records import (
    LaunchRecord as LaunchRecord,
)
from orchestrate.store.records import (
    LaunchRow as LaunchRow,
)
from orchestrate.store.records import (
    Registration as Registration,
)
from orchestrate.store.records import (
    Table as Table,
)
from orchestrate.store.records import (
    Trajectory as Trajectory,
)
from orchestrate.store.records import (
    TrialRow as TrialRow,
)
from orchestrate.store.schema import (
    CONFIG_COLUMNS as CONFIG_COLUMNS,
)
from orchestrate.store.schema import (
    FINISHED as FINISHED,
)
from orchestrate.store.schema import (
    RETRIED as RETRIED,
)
from orchestrate.store.store import LEASE_SECONDS as LEASE_SECONDS
from orchestrate.store.store import Saved as Saved
from orchestrate.store.store import Store as Store
