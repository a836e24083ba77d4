"""Tables of a bundle: one Parquet file for each table of the schema, with typed columns.

Arrays of the table ``trajectory``, packed bytes in a database, are lists of numbers here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sqlalchemy import Double, LargeBinary
from sqlalchemy.types import Integer

from orchestrate.store.schema import alembic_version, metadata

if TYPE_CHECKING:
    import pyarrow as pa

TABLES = tuple(sorted({*metadata.tables} - {alembic_version.name}))
"""Names of the tables but that of the version, which is written in the provenance, and of samples.

Samples are of trials that run, and a bundle holds results.
"""

ARRAY_AXES = {"states": 2, "inputs": 2, "parameters": 1}
"""Number of axes of the arrays of a trajectory: states (T + 1, d), inputs (T, m), parameters."""

PROVENANCE = "provenance.json"
KIND = "dopt results bundle"
"""Entry ``kind`` of the provenance of a bundle."""


def file_name(table: str) -> str:
    return f"{table}.parquet"


def primary_key(table: str) -> tuple[str, ...]:
    """Return the columns by which the rows of a table are ordered."""
    return tuple(column.name for column in metadata.tables[table].primary_key)


def arrow_schema(table: str) -> pa.Schema:
    """Return the columns of the file of a table, in the order of the schema."""
    import pyarrow as pa  # slow to load, and used for bundles and exports only

    columns = metadata.tables[table].columns

    def kind(name: str) -> pa.DataType:
        stored = columns[name].type
        if isinstance(stored, LargeBinary):
            numbers: pa.DataType = pa.float64()
            for _ in range(ARRAY_AXES[name]):
                numbers = pa.list_(numbers)
            return numbers
        if isinstance(stored, Integer):
            return pa.int64()
        return pa.float64() if isinstance(stored, Double) else pa.string()

    return pa.schema([pa.field(column.name, kind(column.name)) for column in columns])
