"""Table changes that SQLite supports only by rebuilding the table."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from alembic import op
from alembic.operations import BatchOperations
from sqlalchemy import CheckConstraint, inspect, text

_OPTIONS = text("SELECT strict, wr FROM pragma_table_list WHERE schema = 'main' AND name = :name")


@contextmanager
def rebuilt(table: str) -> Iterator[BatchOperations]:
    """Open a batch of changes to a table, which is rebuilt on SQLite.

    STRICT, WITHOUT ROWID and the checks are passed explicitly, because not every version of the
    libraries reads them from an existing table.
    """
    connection = op.get_bind()
    if connection.dialect.name != "sqlite":
        with op.batch_alter_table(table) as batch:
            yield batch
        return
    strict, without_rowid = connection.execute(_OPTIONS, {"name": table}).one()
    checks = [
        CheckConstraint(check["sqltext"], name=check["name"])
        for check in inspect(connection).get_check_constraints(table)
    ]
    with op.batch_alter_table(
        table,
        recreate="always",
        table_args=tuple(checks),
        table_kwargs={"sqlite_strict": bool(strict), "sqlite_with_rowid": not without_rowid},
    ) as batch:
        yield batch
