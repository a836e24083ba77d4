"""Import of the tables of a bundle into a new SQLite database, bit for bit.

One number changes: SQLite stores -0.0 in a column of numbers as 0.0, here as in a launch. Losses
and times are never -0.0, and arrays keep it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from sqlalchemy import Connection

from orchestrate.store import schema_version
from orchestrate.store.backends.sqlite_engine import driver_of, filling_engine
from orchestrate.store.bundles.tables import ARRAY_AXES, TABLES, arrow_schema, file_name
from orchestrate.store.errors import StoreUnavailableError
from orchestrate.store.serialization import DTYPE

if TYPE_CHECKING:
    import pyarrow as pa

_ROWS = 50_000


def fill(path: Path, folder: Path) -> None:
    """Create a database at ``path``, which must not exist, with the rows of a bundle.

    Raises ``StoreUnavailableError`` for a file with other columns than those of the schema.
    """
    engine = filling_engine(path)
    try:
        with engine.begin() as connection:
            schema_version.create(connection)
            for table in TABLES:
                _insert(connection, table, folder / file_name(table))
    finally:
        engine.dispose()


def _insert(connection: Connection, table: str, file: Path) -> None:
    schema = arrow_schema(table)
    names = schema.names
    places = ", ".join("?" for _ in names)
    statement = f"INSERT INTO {table} ({', '.join(names)}) VALUES ({places})"
    cursor = driver_of(connection).cursor()
    for batch in _batches(file, schema):
        columns = (_values(batch, name) for name in names)
        cursor.executemany(statement, zip(*columns, strict=True))


def _batches(file: Path, expected: pa.Schema) -> Iterator[pa.RecordBatch]:
    import pyarrow as pa
    import pyarrow.parquet

    try:
        with pa.parquet.ParquetFile(file) as parquet:
            if not parquet.schema_arrow.equals(expected):
                raise StoreUnavailableError(
                    f"The columns of {file} are not those of the schema of this program: "
                    "export the bundle again with 'python -m orchestrate export bundle'."
                )
            yield from parquet.iter_batches(_ROWS)
    except pa.ArrowException as error:
        raise StoreUnavailableError(
            f"The file {file} of the bundle is no Parquet file that can be read "
            f"({str(error).splitlines()[0].rstrip('.')}): copy or download the bundle again."
        ) from error


def _values(batch: pa.RecordBatch, name: str) -> list[Any]:
    """Return a column as the numbers, texts and bytes that SQLite stores."""
    import pyarrow as pa

    column = batch.column(name)
    if name in ARRAY_AXES and pa.types.is_list(column.type):
        return _packed(column, batch.column(f"{name}_shape").to_pylist())
    is_whole = pa.types.is_integer(column.type) and not column.null_count
    if is_whole or pa.types.is_floating(column.type):
        # A missing number becomes NaN, which SQLite stores as NULL.
        values: list[Any] = column.to_numpy(zero_copy_only=False).tolist()
        return values
    return list(column.to_pylist())


def _packed(column: pa.ListArray, shapes: list[str]) -> list[bytes]:
    """Return the numbers of each row of a column of lists, as little-endian bytes."""
    while hasattr(column, "flatten"):
        column = column.flatten()
    numbers = column.to_numpy(zero_copy_only=False).astype(DTYPE, copy=False)
    ends = np.cumsum([math.prod(json.loads(shape)) for shape in shapes])
    return [part.tobytes() for part in np.split(numbers, ends[:-1])]
