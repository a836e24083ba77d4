"""Conversion of Python and NumPy values to what the database drivers store, and back.

The drivers accept no NumPy scalars, NaN, local times or text with zero bytes. Arrays are stored as
little-endian bytes in row-major order, with their type and shape.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
from sqlalchemy import Case, ColumnElement, case

from orchestrate.store.errors import StoreError
from orchestrate.store.records import Array

DTYPE = "<f8"


def plain(value: Any) -> Any:
    """Return a NumPy scalar as a Python number; sqlite3 would store its bytes."""
    return value.item() if isinstance(value, np.generic) else value


def finite(value: float | None) -> float | None:
    """Return the number, or None where it is not finite."""
    return float(value) if value is not None and math.isfinite(value) else None


def finite_list(array: Array) -> list[float | None]:
    """Return the numbers of a vector, with None for those that are not finite."""
    numbers: list[float | None] = array.tolist()
    if np.isfinite(array).all():
        return numbers
    return [finite(number) for number in numbers]


def storable(text: str) -> str:
    """Return the text with zero bytes and lone surrogates escaped, which databases reject."""
    return text.encode(errors="backslashreplace").decode().replace("\0", r"\x00")


def utc_text(moment: datetime) -> str:
    """Return UTC text of fixed width, which sorts by time; raise ValueError without a time zone."""
    if moment.tzinfo is None:
        raise ValueError(f"The time {moment.isoformat()} has no time zone: give one, such as UTC.")
    return moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def now() -> str:
    return utc_text(datetime.now(UTC))


def not_before(column: ColumnElement[str], moment: Any) -> Case[str]:
    """Return a time for SQL that is not before the one in the column, however clocks differ."""
    return case((column > moment, column), else_=moment)


def pack(array: Array) -> tuple[str, bytes]:
    """Return the shape as JSON and the numbers as bytes of type ``DTYPE``."""
    return json.dumps(array.shape), np.ascontiguousarray(array, dtype=DTYPE).tobytes()


def stacked(arrays: Sequence[Array]) -> Array:
    """Return arrays (T_i, k) as one, (n, T, k), with NaN after the end of the shorter ones."""
    longest = max(len(one) for one in arrays)
    result = np.full((len(arrays), longest, *arrays[0].shape[1:]), np.nan)
    for row, one in zip(result, arrays, strict=True):
        row[: len(one)] = one
    return result


def unpack(dtype: str, shape: str, data: bytes) -> Array:
    """Return the packed array in native byte order, writable; raise ``StoreError`` without one."""
    try:
        numbers = np.frombuffer(data, dtype=dtype).reshape(stored_json(shape, list))
        return numbers.astype(np.float64)
    except (ValueError, TypeError) as error:
        raise StoreError(f"An array of the database is damaged ({error}): {_RESTORE}.") from error


def stored_json(text: str, kind: type) -> Any:
    """Return the list or dict of a stored text; raise ``StoreError`` if it holds none."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        found = error
    if isinstance(found, kind):
        return found
    raise StoreError(f"The database holds {text[:40]!r} in the place of JSON: {_RESTORE}.")


_RESTORE = "it was changed by hand, so restore a copy, or give another database"
