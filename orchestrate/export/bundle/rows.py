"""Rows of the tables of a bundle as Arrow batches, in the types of its Parquet files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from orchestrate.redaction import without_password
from orchestrate.store import ConfigRow, Reader
from orchestrate.store.bundle import ARRAY_AXES, arrow_schema, primary_key
from orchestrate.store.serialization import unpack

ROWS = 50_000
"""Rows of a table in one batch; of trajectories, which are long, a hundredth."""

_TRIALS = "JOIN trial ON trial.config_id = config.config_id"
_JOINS = {
    "config": "",
    "trial": _TRIALS,
    **{
        name: f"{_TRIALS} JOIN {name} ON {name}.trial_id = trial.trial_id"
        for name in ("step", "trajectory", "assessment", "attempt")
    },
}
"""Joins of each table with ``config``, of which some rows are selected."""

_REFERENCES = {
    "launch": (
        *(("trial", name) for name in ("owner", "launch_id", "registered_by")),
        ("attempt", "launch_id"),
    ),
    "error": (("trial", "error_id"), ("attempt", "error_id")),
}
"""Columns that refer to the rows of a table."""

_TEXTS_OF_USERS = ("argv", "overrides", "message", "traceback")
"""Columns in which a password could stand."""


class Source:
    """Rows that belong to some of the configurations of a database, or to all of them."""

    def __init__(self, reader: Reader, configs: Sequence[ConfigRow]) -> None:
        self._reader = reader
        self._keys = [config.config_key for config in configs]
        self._is_whole = {*self._keys} == {config.config_key for config in reader.configs()}

    def batches(self, table: str) -> Iterator[pa.RecordBatch]:
        """Yield the rows of a table: by configuration, then in the order of its primary key."""
        schema = arrow_schema(table)
        size = ROWS // 100 if table == "trajectory" else ROWS
        for rows in self._rows(table, size):
            columns = dict(zip(schema.names, zip(*rows, strict=True), strict=True))
            arrays = [_array(field, columns) for field in schema]
            yield pa.RecordBatch.from_arrays(arrays, schema=schema)

    def _rows(self, table: str, size: int) -> Iterator[list[Sequence[Any]]]:
        names = ", ".join(f"{table}.{name}" for name in arrow_schema(table).names)
        order = ", ".join(f"{table}.{name}" for name in primary_key(table))
        if table in _REFERENCES:
            where = "1 = 1" if self._is_whole else f"{order} IN ({self._references(table)})"
            sql = f"SELECT {names} FROM {table} WHERE {where} ORDER BY {order}"
            yield from self._reader.batches(size, sql)
            return
        joins = _JOINS[table]
        sql = f"SELECT {names} FROM config {joins} WHERE config.config_key = :key ORDER BY {order}"
        for key in self._keys:
            yield from self._reader.batches(size, sql, key=key)

    def _references(self, table: str) -> str:
        """Return the numbers of the launches or errors that the selected trials refer to."""
        found: set[int] = {-1}
        for name, column in _REFERENCES[table]:
            sql = (
                f"SELECT DISTINCT {name}.{column} FROM config {_JOINS[name]} "
                f"WHERE config.config_key = :key AND {name}.{column} IS NOT NULL"
            )
            for key in self._keys:
                found.update(int(row[0]) for row in self._reader.rows(sql, key=key))
        return ", ".join(map(str, sorted(found)))


def _array(field: pa.Field, columns: dict[str, tuple[Any, ...]]) -> pa.Array:
    values = columns[field.name]
    if field.name in ARRAY_AXES and pa.types.is_list(field.type):
        shapes = columns[f"{field.name}_shape"]
        packed = zip(columns["dtype"], shapes, values, strict=True)
        return _lists([unpack(*one) for one in packed], ARRAY_AXES[field.name])
    if field.name in _TEXTS_OF_USERS:
        return pa.array([*map(_public, values)], field.type)
    return pa.array(values, field.type)


def _public(text: str | None) -> str | None:
    return None if text is None else without_password(text)


def _lists(arrays: Sequence[np.ndarray[Any, Any]], axes: int) -> pa.Array:
    """Return arrays of the same number of axes as nested lists, without touching their numbers."""
    column = pa.array(np.concatenate([array.ravel() for array in arrays]))
    for axis in reversed(range(axes)):
        lengths = [
            np.full(int(np.prod(array.shape[:axis])), array.shape[axis], np.int64)
            for array in arrays
        ]
        ends = np.cumsum(np.concatenate([[0], *lengths]))
        column = pa.ListArray.from_arrays(pa.array(ends, pa.int32()), column)
    return column
