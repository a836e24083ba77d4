"""PostgreSQL: many writers, COPY for steps, liveness by a lease on the server's clock."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import repeat
from typing import TYPE_CHECKING, Any, cast

from sqlalchemy import (
    ARRAY,
    URL,
    Connection,
    Engine,
    Select,
    Text,
    bindparam,
    create_engine,
    event,
    func,
    select,
    text,
    update,
)

from orchestrate.store import address
from orchestrate.store.backend import Backend, LaunchLife
from orchestrate.store.errors import StoreError
from orchestrate.store.records import Array
from orchestrate.store.schema import STEP_VALUES, launch
from orchestrate.store.values import finite_list

if TYPE_CHECKING:
    import psycopg

# Bounds on a silent cut of the network, after which the driver raises instead of waiting.
_TIMEOUTS = {
    "connect_timeout": "5",
    "tcp_user_timeout": "10000",  # milliseconds
    "keepalives_idle": "5",
    "keepalives_interval": "2",
    "keepalives_count": "3",
}

_NOW = text("SELECT extract(epoch FROM clock_timestamp())::double precision")
_COPY_STEP = f"COPY step (trial_id, t, {', '.join(STEP_VALUES)}) FROM STDIN (FORMAT BINARY)"
_COPY_TYPES = ["int8", "int4", *("float8" for _ in STEP_VALUES)]
_LOCK = text("SELECT pg_advisory_xact_lock(hashtext('dopt.store.' || current_schema()))")


class PostgreSQLBackend(Backend):
    """A schema of a PostgreSQL database: the first one of the connection's search path."""

    def __init__(self, url: URL, lease_seconds: float) -> None:
        super().__init__(_engine(url), address.safe(url))
        self._lease_seconds = lease_seconds

    @contextmanager
    def creation(self) -> Iterator[Connection]:
        with self.transaction() as connection:
            self.exclusive(connection)
            yield connection

    def exclusive(self, connection: Connection) -> None:
        connection.execute(_LOCK)

    def members(self, keys: Sequence[str]) -> Select[Any]:
        listed = bindparam("keys", list(keys), type_=ARRAY(Text), unique=True)
        return select(func.unnest(listed).column_valued("key"))

    def insert_steps(self, connection: Connection, trial_id: int, values: Array) -> None:
        driver = cast("psycopg.Connection", connection.connection.driver_connection)
        columns = [finite_list(column) for column in values.T]
        with driver.cursor() as cursor, cursor.copy(_COPY_STEP) as copy:
            copy.set_types(_COPY_TYPES)
            for row in zip(repeat(trial_id), range(len(values)), *columns, strict=False):
                copy.write_row(row)

    def hold(self, connection: Connection, launch_id: int, token: str) -> None:  # noqa: ARG002
        self.renew(connection, launch_id)

    def renew(self, connection: Connection, launch_id: int) -> None:
        until = self._clock(connection) + self._lease_seconds
        connection.execute(
            update(launch).where(launch.c.launch_id == launch_id).values(lease_until=until)
        )

    def dead(self, connection: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:
        now = self._clock(connection)
        return [one for one in launches if one.lease_until is None or one.lease_until < now]

    def let_go(self, token: str) -> None:
        """Do nothing: a lease runs out by itself."""

    def close(self) -> None:
        self.engine.dispose()

    @staticmethod
    def _clock(connection: Connection) -> float:
        return float(connection.execute(_NOW).scalar_one())


def read_engine(url: URL) -> Engine:
    """Return an engine whose transactions are snapshots and cannot write."""
    engine = _engine(url)

    @event.listens_for(engine, "connect")
    def _forbid_writes(connection: psycopg.Connection, _: object) -> None:
        # For the session, not for one transaction: a COMMIT in a query does not end it.
        connection.execute("SET default_transaction_read_only = on")
        connection.commit()

    return engine.execution_options(isolation_level="REPEATABLE READ")


def _engine(url: URL) -> Engine:
    timeouts = {key: value for key, value in _TIMEOUTS.items() if key not in url.query}
    try:
        return create_engine(url, connect_args=timeouts, pool_pre_ping=True)
    except ModuleNotFoundError as error:
        raise StoreError(
            f"A PostgreSQL database needs the library {error.name}: "
            "install it with pip install 'dopt[postgres]'."
        ) from error
