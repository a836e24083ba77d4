"""PostgreSQL backend: concurrent writers, COPY for steps, leases on the server's clock."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from itertools import count, repeat
from pathlib import Path
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
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from dopt.errors import install_command
from dopt.types import Array
from orchestrate.errors import StoreError, StoreUnavailableError
from orchestrate.store.backend import (
    ANNOUNCE_SECONDS,
    Backend,
    LaunchLife,
    NewTrial,
    back_up_to,
    dump,
    log,
    public_url,
)
from orchestrate.store.records import finite_list
from orchestrate.store.schema import LOCK_TABLE, STEP_VALUES, launch

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
    INSERT INTO trial (trial_key, config_id, seed, status, attempt, registered_by)
    SELECT *, 'pending', 0, CAST(:launch_id AS bigint)
    FROM unnest(CAST(:keys AS text[]), CAST(:config_ids AS bigint[]), CAST(:seeds AS bigint[]))
    """
)
# No SELECT takes this lock, and none that a reader or VACUUM takes of other tables waits for it.
_LOCK = text(f"LOCK TABLE {LOCK_TABLE} IN SHARE ROW EXCLUSIVE MODE")
_HAS_LOCK = text(
    f"SELECT to_regclass(quote_ident(current_schema()) || '.{LOCK_TABLE}') IS NOT NULL"
)
_CREATE_LOCK = text(f"CREATE TABLE {LOCK_TABLE} ()")
_CREATED_BY_ANOTHER = ("23505", "42P07")
_WATCH_SECONDS = 0.5
_SESSION = "dopt launch"
_BLOCKER = text(
    f"""
    SELECT coalesce('process ' || s.pid || ' of the user ' || coalesce(s.usename, '?')
                    || coalesce(' (' || nullif(s.application_name, '') || ')', ''),
                    'a prepared transaction') AS name,
           coalesce(s.application_name LIKE '{_SESSION} %', false) AS is_launch
    FROM unnest(pg_blocking_pids(:pid)) AS b(pid) LEFT JOIN pg_stat_activity AS s USING (pid)
    ORDER BY s.xact_start LIMIT 1
    """
)
_CANCEL = text("SELECT pg_cancel_backend(:pid)")
_HURRY = text("SET LOCAL lock_timeout = '1s'")

# A launch that is suspended while it sends rows of a COPY or statements of a pipeline keeps its
# locks: no timeout of the server ends a session in the middle of a message from its client. Other
# launches of the same role end such a session when its lease is over.
_EVICT = text(
    f"""
    SELECT pg_terminate_backend(session.pid)
    FROM pg_stat_activity AS session
    WHERE session.datname = current_database() AND session.usename = current_user
      AND session.xact_start IS NOT NULL
      AND session.application_name <> current_setting('application_name')
      AND session.application_name IN (
        SELECT '{_SESSION} ' || split_part(token, '-', 1) FROM launch
        WHERE lease_until < extract(epoch FROM clock_timestamp())
      )
    """
)
_OWN = "FROM pg_class WHERE relkind = 'r' AND relnamespace = to_regnamespace(current_schema())"
_SCHEMA = text("SELECT current_schema(), quote_ident(current_schema())")
_SIZE = text(f"SELECT coalesce(sum(pg_total_relation_size(oid)), 0) {_OWN}")
_HAS_LAUNCHES = text("SELECT to_regclass('launch') IS NOT NULL")


class PostgreSQLBackend(Backend):
    """Schema of a PostgreSQL database: the first one of the connection's search path."""

    def __init__(self, url: URL, lease_seconds: float, patience: float) -> None:
        self._session = uuid.uuid4().hex
        self._url = url
        engine = _write_engine(url, lease_seconds, patience, self._session)
        super().__init__(engine, public_url(url))
        self._lease_seconds = lease_seconds
        self._patience = patience

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        ended, given_up = threading.Event(), list[str]()
        try:
            with super().transaction() as connection, ExitStack() as stack:
                driver = cast("psycopg.Connection", connection.connection.driver_connection)
                words = (driver.info.backend_pid, ended, given_up)
                watch = threading.Thread(target=self._watch, args=words, daemon=True)
                watch.start()
                stack.callback(watch.join, ANNOUNCE_SECONDS)  # it may hold a connection
                stack.callback(ended.set)
                yield connection
        except StoreUnavailableError as error:
            if given_up:
                raise StoreUnavailableError(given_up[0]) from error
            raise

    def _watch(self, pid: int, ended: threading.Event, given_up: list[str]) -> None:
        """End launches that hold the lock and are dead; say who holds it; give up in the end.

        A launch that holds it may be dead for a whole lease before the server ends it.
        """
        start, said = None, False
        while not ended.wait(_WATCH_SECONDS):
            with suppress(SQLAlchemyError), self.engine.begin() as connection:
                blocker = connection.execute(_BLOCKER, {"pid": pid}).one_or_none()
                if blocker is None or ended.is_set():
                    start = None
                    continue
                start = start or time.monotonic() - _WATCH_SECONDS
                waited = time.monotonic() - start
                if waited >= self._patience + self._lease_seconds * blocker.is_launch:
                    given_up.append(
                        f"The results database {self.safe_url} cannot be used: {blocker.name} has "
                        f"held a lock on it for {waited:.0f} s; end it, and run the same command "
                        "again."
                    )
                    connection.execute(_CANCEL, {"pid": pid})
                    return
                if waited >= ANNOUNCE_SECONDS and not said:
                    said = True
                    log.warning(
                        "waiting for a lock of %s, which %s holds", self.safe_url, blocker.name
                    )
                connection.execute(_HURRY)
                _end_dead(connection)

    @contextmanager
    def creation(self) -> Iterator[Connection]:
        with self.transaction() as connection:
            self.exclusive(connection)
            yield connection

    def back_up(self, connection: Connection, version: int) -> str:
        here, schema = connection.execute(_SCHEMA).one()
        base = f"{self._url.database}-{here}.v{version}-backup"
        write = partial(dump, self._url, schema, otherwise=", or give --no-backup")
        return back_up_to(str(Path.cwd() / base), ".dump", write)

    def exclusive(self, connection: Connection) -> None:
        if not connection.execute(_HAS_LOCK).scalar_one():
            try:  # a transaction that creates it too waits for this one
                with connection.begin_nested():
                    connection.execute(_CREATE_LOCK)
            except DBAPIError as error:
                if getattr(error.orig, "sqlstate", None) not in _CREATED_BY_ANOTHER:
                    raise
        connection.execute(_LOCK)

    def members(self, keys: Sequence[str]) -> Select[Any]:
        listed = bindparam("keys", list(keys), type_=ARRAY(Text), unique=True)
        return select(func.unnest(listed).column_valued("key"))

    def insert_trials(
        self, connection: Connection, trials: Sequence[NewTrial], launch_id: int
    ) -> None:
        keys, config_ids, seeds = map(list, zip(*trials, strict=True))
        given = {"keys": keys, "config_ids": config_ids, "seeds": seeds, "launch_id": launch_id}
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

    def renew(self, connection: Connection, launch_id: int) -> None:
        until = _clock(connection) + self._lease_seconds
        connection.execute(
            update(launch).where(launch.c.launch_id == launch_id).values(lease_until=until)
        )

    def dead(self, connection: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:
        return dead(self._url, connection, launches)

    def token(self) -> str:
        return f"{self._session}-{super().token()}"

    def evict(self) -> None:
        # In a short transaction of its own: it reads a table that an upgrade locks.
        with self.transaction() as connection:
            _end_dead(connection)

    def close(self) -> None:
        self.engine.dispose()


def _end_dead(connection: Connection) -> None:
    """End the sessions of launches whose lease is over."""
    if connection.execute(_HAS_LAUNCHES).scalar_one():
        connection.execute(_EVICT)


def dead(_: URL, connection: Connection, launches: Sequence[LaunchLife]) -> list[LaunchLife]:
    """Return the launches whose lease has expired."""
    now = _clock(connection)
    return [one for one in launches if one.lease_until is None or one.lease_until < now]


def _clock(connection: Connection) -> float:
    return float(connection.execute(_NOW).scalar_one())


def _write_engine(url: URL, lease_seconds: float, patience: float, session: str) -> Engine:
    engine = _engine(url, application_name=f"{_SESSION} {session}")

    @event.listens_for(engine, "connect")
    def _bound_silence(connection: psycopg.Connection, _: object) -> None:
        # A launch that is suspended in a transaction would keep its rows locked.
        milliseconds = max(1, round(1000 * lease_seconds))
        connection.execute(f"SET idle_in_transaction_session_timeout = {milliseconds}")
        # Longer than the thread that watches a transaction lets it wait.
        longest = round(1000 * (lease_seconds + patience + 5))
        connection.execute(f"SET lock_timeout = {longest}")
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
        connection.execute("SET default_transaction_read_only = on; SET lock_timeout = '30s'")
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


def _settings(url: URL, **more: str) -> dict[str, str]:
    wanted = {**_CONNECTION, **more}
    return {key: value for key, value in wanted.items() if key not in url.query}


def _engine(url: URL, **more: str) -> Engine:
    try:
        return create_engine(url, connect_args=_settings(url, **more), pool_pre_ping=True)
    except ModuleNotFoundError as error:
        raise StoreError(
            f"A PostgreSQL database needs the library {error.name}: "
            f"install it with {install_command('postgres')}."
        ) from error
