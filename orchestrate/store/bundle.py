"""Bundles: folders with the tables of a results database as Parquet files, and their import.

Each table of the schema is a file with typed columns; arrays of the table ``trajectory``, packed
bytes in a database, are lists of numbers there. An import keeps every bit, except that SQLite
stores -0.0 in a column of numbers as 0.0, as in a launch. Losses and times are never -0.0, and
arrays keep it.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from sqlalchemy import Connection, Double, LargeBinary
from sqlalchemy.types import Integer

from orchestrate.errors import SchemaVersionError, StoreError, StoreUnavailableError
from orchestrate.store import schema
from orchestrate.store.backends.base import translated_file
from orchestrate.store.backends.sqlite_engine import driver_of, filling_engine
from orchestrate.store.doctor import TrialKey
from orchestrate.store.merge import Merged, merge
from orchestrate.store.records import DTYPE
from orchestrate.store.schema import SCHEMA_VERSION, alembic_version, curve, metadata

if TYPE_CHECKING:
    import pyarrow as pa

TABLES = tuple(sorted({*metadata.tables} - {alembic_version.name, curve.name}))
"""Names of the tables except the version, which the provenance holds, and the packed curves."""

ARRAY_AXES = {"states": 2, "inputs": 2, "parameters": 1}
"""Number of axes of the arrays of a trajectory: states (T + 1, d), inputs (T, m), parameters."""

PROVENANCE = "provenance.json"
KIND = "dopt results bundle"
"""Entry ``kind`` of the provenance of a bundle."""

CHECKSUMS = "SHA256SUMS"

_LINE = re.compile(r"([0-9a-f]{64}) [ *]([\w.-]+)")
_RESTORE = "copy or download the bundle again"
_WRITTEN = "a folder that 'python -m orchestrate export bundle' has written"
_ROWS = 50_000


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


def write_checksums(folder: Path) -> None:
    """Write the SHA-256 of all files of the folder, as ``sha256sum --check`` reads them."""
    files = sorted(path for path in folder.iterdir() if path.name != CHECKSUMS)
    lines = [f"{digest(path)}  {path.name}\n" for path in files]
    (folder / CHECKSUMS).write_text("".join(lines))


def merge_bundle(url: str, folder: Path, trial_key: TrialKey | None = None) -> Merged:
    """Import the trials of a bundle into a database, as :func:`merge` does from another one.

    Raises ``StoreError`` for a folder that is no bundle, ``SchemaVersionError`` for a bundle of
    another schema, and ``StoreUnavailableError`` for a damaged file, which the message names.
    """
    with translated_file(str(folder)), tempfile.TemporaryDirectory(prefix="dopt-") as local:
        _check(folder)
        copy = Path(local) / "bundle.db"
        fill(copy, folder)
        return merge(url, f"sqlite:///{copy}", trial_key)


def _check(folder: Path) -> None:
    """Compare every file with its SHA-256."""
    listed = folder / CHECKSUMS
    if not listed.is_file():
        raise StoreError(
            f"{folder} is no bundle, because it has no file {CHECKSUMS}: give {_WRITTEN}."
        )
    lines = listed.read_text(encoding="utf-8", errors="replace").splitlines()
    found = [_LINE.fullmatch(line) for line in lines]
    if not all(found):
        raise StoreUnavailableError(
            f"The file {listed} is damaged, lines with a SHA-256 and a name are expected: "
            f"{_RESTORE}."
        )
    needed = dict.fromkeys([PROVENANCE, *map(file_name, TABLES)], "")
    _verify(folder, {**needed, **{match[2]: match[1] for match in found if match}})
    facts = json.loads((folder / PROVENANCE).read_text(encoding="utf-8"))
    if not isinstance(facts, dict) or facts.get("kind") != KIND:
        raise StoreError(
            f"{folder} is no bundle, its {PROVENANCE} describes something else: give {_WRITTEN}."
        )


def _verify(folder: Path, expected: Mapping[str, str]) -> None:
    for name, wanted in expected.items():
        path = folder / name
        if not path.is_file():
            raise StoreUnavailableError(
                f"The file {path} of the bundle, listed in {CHECKSUMS}, is missing: {_RESTORE}."
            )
        if digest(path) != wanted:
            raise StoreUnavailableError(
                f"The file {path} of the bundle is damaged, its SHA-256 is not the one in "
                f"{CHECKSUMS}: {_RESTORE}."
            )


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def fill(path: Path, folder: Path) -> None:
    """Create a SQLite database with the rows of a bundle, whose files were checked."""
    engine = filling_engine(path)
    try:
        with engine.begin() as connection:
            schema.create(connection)
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
                raise SchemaVersionError(
                    f"The columns of {file} differ from schema {SCHEMA_VERSION}: import the "
                    "bundle with the release that has written it, and upgrade that database."
                )
            yield from parquet.iter_batches(_ROWS)
    except pa.ArrowException as error:
        raise StoreUnavailableError(
            f"The file {file} of the bundle is no Parquet file that can be read "
            f"({str(error).splitlines()[0].rstrip('.')}): {_RESTORE}."
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
