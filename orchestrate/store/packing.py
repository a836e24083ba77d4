"""Arrays as bytes: little-endian, rows first, with their type and shape beside them."""

from __future__ import annotations

import json

import numpy as np

from orchestrate.store.records import Array

DTYPE = "<f8"


def pack(array: Array) -> tuple[str, bytes]:
    """Return the shape as JSON and the numbers as bytes of type ``DTYPE``."""
    return json.dumps(array.shape), np.ascontiguousarray(array, dtype=DTYPE).tobytes()


def unpack(dtype: str, shape: str, data: bytes) -> Array:
    """Return the array of native byte order that was packed; it can be written to."""
    return np.frombuffer(data, dtype=dtype).reshape(json.loads(shape)).astype(np.float64)
