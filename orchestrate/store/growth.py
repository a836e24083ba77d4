"""Comparison of two explorations of one key: the same one after fewer steps, or another one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from orchestrate.store.records import Array
from orchestrate.store.serialization import unpack

ROUNDING = 1e-6
"""Difference of two states, relative to their size or 1, that counts as none."""

Path = tuple[Array, Array]
"""States (T + 1, d) and inputs (T, m)."""


def steps_ahead(one: Path, other: Path) -> int | None:
    """Return how many steps the first path has more than the second; None for different paths.

    The last state of the shorter one is not compared: after a gap an exploration goes on from
    another state. States may be estimates, which another processor computes with other rounding.
    """
    n = min(len(one[1]), len(other[1]))
    states = (one[0][:n], other[0][:n])
    same = np.array_equal(one[1][:n], other[1][:n], equal_nan=True) and (
        states[0].shape == states[1].shape
        and np.allclose(*states, rtol=ROUNDING, atol=ROUNDING, equal_nan=True)
    )
    return len(one[1]) - len(other[1]) if same else None


def unpacked(row: Mapping[str, Any]) -> Path:
    """Return the path in a row of the table ``trajectory``."""
    states = unpack(row["dtype"], row["states_shape"], row["states"])
    return states, unpack(row["dtype"], row["inputs_shape"], row["inputs"])
