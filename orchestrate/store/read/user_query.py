"""Execution of one SELECT of a user, read-only and with limits of rows and time."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

from sqlalchemy import Connection, Engine

from orchestrate.store.errors import QueryError
from orchestrate.store.read.rows import Table

Guard = Callable[[Connection, float | None], AbstractContextManager[None]]


def run_select(
    engine: Engine, guard: Guard, sql: str, limit: int | None = None, timeout: float | None = None
) -> Table:
    """Return the first ``limit`` rows of the statement.

    ``guard`` rejects statements that do not only read, and cancels them after ``timeout`` seconds;
    the transaction is rolled back. A server-side cursor accepts one SELECT only, whereas a plain
    statement may be several.
    """
    # Without parameters, so that a % in the statement needs no escape.
    options: dict[str, Any] = {"no_parameters": True, "stream_results": True}
    if limit is not None:
        options["yield_per"] = limit + 1
    with engine.connect() as connection, connection.begin() as transaction:
        with (
            guard(connection, timeout),
            connection.exec_driver_sql(sql, execution_options=options) as result,
        ):
            if not result.returns_rows:
                raise QueryError("The query returns no rows: give one SELECT.")
            rows = result.fetchall() if limit is None else result.fetchmany(limit + 1)
            columns = result.keys()
        transaction.rollback()
    return Table(columns, rows[:limit], cut=limit is not None and len(rows) > limit)
