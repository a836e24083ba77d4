"""Types of arguments that refuse in one sentence what they cannot use."""

from __future__ import annotations

from collections.abc import Callable

from orchestrate.usage import Parser, UsageError

__all__ = ["Parser", "UsageError", "positive"]


def positive(option: str, number: type[int] | type[float]) -> Callable[[str], float]:
    """Return the type of an option that is a number above 0."""

    def read(given: str) -> float:
        try:
            value = number(given)
        except ValueError:
            value = number(0)
        if not 0 < value < float("inf"):
            kind = "whole number" if number is int else "number"
            raise UsageError(f"{option} is {given!r}, a {kind} above 0 is expected: give one.")
        return value

    return read
