"""Bounds of a state or a parameter vector in compiled code."""

from __future__ import annotations

from dopt.kernel.compiler import compiled
from dopt.types import Vector


@compiled
def within(x: Vector, limit: float) -> bool:
    """Tell whether every entry is finite and within the limit."""
    inside = True
    for i in range(x.shape[0]):
        inside = inside and abs(x[i]) <= limit
    return inside
