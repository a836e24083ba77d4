"""PostgreSQL backend: concurrent writers, COPY for steps, leases on the server's clock."""

from __future__ import annotations

import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import count, repeat
from types import MappingProxyType
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

from dopt.errors import install_command
from orchestrate.store import database_url
from orchestrate.store.backends.base import Backend, LaunchLife, NewTrial
from orchestrate.store.backends.postgresql_backup import copy_schema
from orchestrate.store.errors import StoreError
from orchestrate.store.records import Array
from orchestrate.store.schema import STEP_VALUES, launch
from orchestrate.store.serialization import finite_list

if TYPE_CHECKING:
    import psycopg

# Seconds and number of TCP keepalives before a connection counts as lost.
_KEEPALIVES = {"keepalives_idle": "5", "keepalives_interval": "2", "keepalives_count": "3"}
_CONNECTION = {
    # A database with encoding SQL_ASCII (a server without a locale) would return bytes.
    "client_encoding": "utf8",
    # Limits for a silent loss of the network, after which the driver raises an error.
    "connect_timeout": "5",
    "tcp_user_timeout": "10000",  # milliseconds
    **_KEEPALIVES,
}

_NOW = text("SELECT extract(epoch FROM clock_timestamp())::double precision")
_COPY_STEP = f"COPY step (trial_id, t, {', '.join(STEP_VALUES)}) FROM STDIN (FORMAT BINARY)"
_COPY_TYPES = ["int8", "int4", *("float8" for _ in STEP_VALUES)]
# One statement for many rows: a statement for each takes twice the time, here and on the server.
_INSERT_TRIALS = text(
    """
    INSERT INTO trial (trial_key, config_id, seed, status, attempt)
    SELECT *, 'pending', 0
    FROM unnest(CAST(:keys AS text[]), CAST(:config_ids AS bigint[]), CAST(:seeds AS bigint[]))
    """
)
_SET_LOCK_TIMEOUT = text("SET LOCAL lock_timeout = '30s'")
_LOCK = text("SELECT pg_try_advisory_xact_lock(hashtext('dopt.store.' || current_schema()))")
_LOCK_PAUSE_SECONDS = 0.05
_SESSION = "dopt launch"

# A launch that is suspended while it sends rows of a COPY or statements of a pipeline keeps its
# locks: no timeout of the server ends a session in the middle of a message from its client. Other
# launches of the same role end such a session when its lease is over.
_EVICT = text(
    f"""
    SELECT pg_terminate_backend(session.pid)
    FROM pg_stat_activity AS session
    WHERE session.datname = current_database() AND session.usename = current_user
      AND session.xact_start IS NOT NULL AND session.pid <> pg_backend_pid()
      AND session.application_name IN (
        SELECT '{_SESSION} ' || split_part(token, '-', 1) FROM launch
        WHERE lease_until < extract(epoch FROM clock_timestamp())
      )
    """
)
_OWN = "FROM pg_class WHERE relkind = 'r' AND relnamespace = to_regnamespace(current_schema())"
_TABLES = text(f"SELECT oid::regclass::text {_OWN} AND relname <> 'alembic_version'")
_SIZE = text(f"SELECT coalesce(sum(pg_total_relation_size(oid)), 0) {_OWN}")
_HAS_LAUNCHES = text("SELECT to_regclass('launch') IS NOT NULL")


class PostgreSQLBackend(Backend):
    """Schema of a PostgreSQL database: the first one of the connection's search path."""

    def __init__(self, url: URL, lease_seconds: float) -> None:
        self._session = uuid.uuid4().hex
        super().__init__(_write_engine(url, lease_seconds, self._session), database_url.safe(url))
        self._lease_seconds = lease_seconds

    @contextmanager
    def creation(self) -> Iterator[Connection]:
        with self.transaction() as connection:
            self.exclusive(connection)
            yield connection

    @contextmanager
    def rebuilding(self) -> Iterator[Connection]:
        with self.creation() as connection:
            connection.execute(_SET_LOCK_TIMEOUT)
            yield connection

    def back_up(self, connection: Connection, version: int) -> str:
        return copy_schema(connection, version, self.safe_url)

    def discard_backup(self, name: str) -> None:
        """Do nothing: the copy was made in the transaction that was rolled back."""

    def exclusive(self, connection: Connection) -> None:
        while not connection.execute(_LOCK).scalar_one():
            self.evict()
            time.sleep(_LOCK_PAUSE_SECONDS)

    def members(self, keys: Sequence[str]) -> Select[Any]:
        listed = bindparam("keys", list(keys), type_=ARRAY(Text), unique=True)
        return select(func.unnest(listed).column_valued("key"))

    def insert_trials(self, connection: Connection, trials: Sequence[NewTrial]) -> None:
        keys, config_ids, seeds = map(list, zip(*trials, strict=True))
        given = {"keys": keys, "config_ids": config_ids, "seeds": seeds}
        connection.execute(_INSERT_TRIALS, given)

    def insert_steps(
        self, connection: Connection, trial_id: int, values: Array, first: int = 0
    ) -> None:
        driver = cast("psycopg.Connection", connection.connection.driver_connection)
        columns = [finite_list(column) for column in values.T]
        with driver.cursor() as cursor, cursor.copy(_COPY_STEP) as copy:
            copy.set_types(_COPY_TYPES)
            for row in zip(repeat(trial_id), count(first), *columns, strict=False):
                copy.write_row(row)

    def hold(self, connection: Connection, launch_id: int, token: str) -> None:  # noqa: ARG002
        self.renew(connection, launch_id)

    def renew(self, connection: Connection, launch_id: int) -> None:
        until = _clock(connection) + self._lease_seconds
        connection.execute(
            update(launch).where(launch.c.launch_id == launch_id).values(lease_until=until)
        )

    def dead(self, connection: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:
        return _dead(connection, launches)

    def token(self) -> str:
        return f"{self._session}-{super().token()}"

    @property
    def needs_rest(self) -> bool:
        return False

    def vacuum(self) -> None:
        with self.engine.connect() as connection:
            tables = ", ".join(connection.execute(_TABLES).scalars())
            connection.rollback()
            alone = connection.execution_options(isolation_level="AUTOCOMMIT")
            alone.exec_driver_sql(f"VACUUM (ANALYZE) {tables}")

    def evict(self) -> None:
        # In a short transaction of its own: it reads a table that an upgrade locks.
        with self.transaction() as connection:
            if connection.execute(_HAS_LAUNCHES).scalar_one():
                connection.execute(_EVICT)

    def forget(self, token: str) -> None:
        """Do nothing: a lease expires by itself."""

    def close(self) -> None:
        self.engine.dispose()


def dead(_: URL, connection: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:
    """Return the launches whose lease has expired, for a reader."""
    return _dead(connection, launches)


def _dead(connection: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:
    now = _clock(connection)
    return [one for one in launches if one.lease_until is None or one.lease_until < now]


def _clock(connection: Connection) -> float:
    return float(connection.execute(_NOW).scalar_one())


def _write_engine(url: URL, lease_seconds: float, session: str) -> Engine:
    engine = _engine(url, {"application_name": f"{_SESSION} {session}"})

    @event.listens_for(engine, "connect")
    def _bound_silence(connection: psycopg.Connection, _: object) -> None:
        # A launch that is suspended in a transaction would keep its rows locked.
        milliseconds = max(1, round(1000 * lease_seconds))
        connection.execute(f"SET idle_in_transaction_session_timeout = {milliseconds}")
        # So would one whose machine is lost while it sends steps: the server sends keepalives too.
        connection.execute("; ".join(f"SET tcp_{key} = {n}" for key, n in _KEEPALIVES.items()))
        connection.commit()

    return engine


def read_engine(url: URL) -> Engine:
    """Return an engine whose transactions are snapshots and cannot write."""
    engine = _engine(url)

    @event.listens_for(engine, "connect")
    def _forbid_writes(connection: psycopg.Connection, _: object) -> None:
        # For the session, not for one transaction: a COMMIT in a query does not end it.
        connection.execute("SET default_transaction_read_only = on")
        connection.commit()

    return engine.execution_options(isolation_level="REPEATABLE READ")


def size(connection: Connection) -> int:
    """Return the bytes of the tables and indexes of the schema."""
    return int(connection.execute(_SIZE).scalar_one())


def request(url: URL) -> dict[str, Any]:
    """Return how the process of a query connects.

    Access of a SELECT beside the tables, such as ``pg_read_file``, depends on the rights of the
    database user; a session cannot drop them.
    """
    _, arguments = _engine(url).dialect.create_connect_args(url)
    del arguments["context"]  # SQLAlchemy's own conversions of what is sent
    return {"driver": "postgresql", "connection": {**_settings(url), **arguments}}


def _settings(url: URL, more: Mapping[str, str] = MappingProxyType({})) -> dict[str, str]:
    wanted = {**_CONNECTION, **more}
    return {key: value for key, value in wanted.items() if key not in url.query}


def _engine(url: URL, more: Mapping[str, str] = MappingProxyType({})) -> Engine:
    try:
        return create_engine(url, connect_args=_settings(url, more), pool_pre_ping=True)
    except ModuleNotFoundError as error:
        raise StoreError(
            f"A PostgreSQL database needs the library {error.name}: "
            f"install it with {install_command('postgres')}."
        ) from error
