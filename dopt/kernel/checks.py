"""What a state or a parameter vector has to satisfy, in compiled code."""

from __future__ import annotations

from typing import Any

from dopt.kernel.compiler import compiled


@compiled
def within(x: Any, limit: float) -> bool:
    """Tell whether every entry is finite and within the limit."""
    inside = True
    for i in range(x.shape[0]):
        inside = inside and abs(x[i]) <= limit
    return inside
