"""One SELECT that somebody typed: it can only read, and ends within its limits."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

from sqlalchemy import Connection, Engine

from orchestrate.store.errors import QueryError
from orchestrate.store.rows import Table

Guard = Callable[[Connection, float | None], AbstractContextManager[None]]


def ask(
    engine: Engine, guard: Guard, sql: str, limit: int | None = None, timeout: float | None = None
) -> Table:
    """Return the rows of the statement, the first ``limit`` of them.

    ``guard`` refuses what does not read and ends what takes longer than ``timeout`` seconds; the
    transaction is rolled back, so that nothing of the statement outlives it. A cursor on the side
    of the server takes one SELECT, where a statement sent as it is may be several.
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
                raise QueryError("The query asks for nothing: give one SELECT.")
            rows = result.fetchall() if limit is None else result.fetchmany(limit + 1)
            columns = result.keys()
        transaction.rollback()
    return Table(columns, rows[:limit], cut=limit is not None and len(rows) > limit)
