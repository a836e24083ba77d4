"""Plain values for the drivers: no NumPy scalars, no NaN, no local time, no text they refuse."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Any

import numpy as np

from orchestrate.store.records import Array


def plain(value: Any) -> Any:
    """Return a NumPy scalar as the Python number it stands for; sqlite3 would store its bytes."""
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
    """Return the text with what no database takes made visible: zeros and halves of characters."""
    return text.encode(errors="backslashreplace").decode().replace("\0", r"\x00")


def utc_text(moment: datetime) -> str:
    """Return UTC text of fixed width, which sorts like time; ValueError without a time zone."""
    if moment.tzinfo is None:
        raise ValueError(f"The time {moment.isoformat()} has no time zone: give one, such as UTC.")
    return moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def now() -> str:
    return utc_text(datetime.now(UTC))
