"""Type and range checks of single settings; each refusal names the key, the value and the range."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from orchestrate.errors import LaunchError

LARGEST = 1_000_000_000
"""Bound of seconds and GiB: system timers and limits overflow above it."""

_PRECISION = re.compile(r"ci\s*<\s*(\d+(?:\.\d+)?)\s*%")


def section(key: str, value: object) -> Mapping[str, Any]:
    """Return a mapping of settings."""
    if isinstance(value, Mapping):
        return value
    raise wrong(key, value, "a section with settings of its own")


def flag(key: str, value: object) -> bool:
    """Return a boolean."""
    if isinstance(value, bool):
        return value
    raise wrong(key, value, "true or false")


def text(key: str, value: object) -> str:
    """Return a non-empty text."""
    if isinstance(value, str) and value:
        return value
    raise wrong(key, value, "a text")


def count(key: str, value: object) -> int | None:
    """Return a positive whole number, or None."""
    if value is None or (isinstance(value, int) and not isinstance(value, bool) and value > 0):
        return value
    raise wrong(key, value, "null or a whole number above 0")


def limit(key: str, value: object, unit: str) -> float | None:
    """Return a positive number, or None for no limit."""
    return None if value is None else amount(key, value, unit, "null or a number")


def amount(key: str, value: object, unit: str, kind: str = "a number") -> float:
    """Return a positive number below :data:`LARGEST`."""
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < LARGEST:
        return float(value)
    raise wrong(key, value, f"{kind} of {unit} above 0 and below {LARGEST:,}")


def factor(key: str, value: object, limit_key: str, limited: object) -> float | None:
    """Return a factor by which a limit is raised, which has to be set; or None."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1 < value <= 100:
        raise wrong(key, value, "null or a factor above 1, at most 100,")
    if limited is None:
        raise LaunchError(
            f"{key} is {value:g}, but there is no limit that it could raise: set {limit_key}, or "
            f"leave {key} out."
        )
    return float(value)


def wrong(key: str, value: object, expected: str) -> LaunchError:
    """Return the error for a setting with an invalid value."""
    return LaunchError(f"{key} is {value!r}, but {expected} is expected: change {key}.")


def precision(key: str, value: object) -> float | None:
    """Return the share of a mean to within which it shall be known: 0.05 for ``ci<5%``, or None."""
    match = _PRECISION.fullmatch(value.strip()) if isinstance(value, str) else None
    if match and 0 < float(match[1]) < 100:
        return float(match[1]) / 100
    if value is None:
        return None
    raise wrong(
        key,
        value,
        "null or ci<P% with P above 0 and below 100 (the geometric mean of the final loss is known "
        "to within P percent), such as 'ci<5%',",
    )
