"""Parser of query parameters; an invalid value raises ``RequestError`` with one sentence."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import TypeVar

from analysis.data.config_matching import Filter, read_condition
from analysis.serve.errors import RequestError
from dopt.errors import suggestion

E = TypeVar("E", bound=StrEnum)

LARGEST = 2**31 - 1
"""Largest integer; both databases accept it for every integer column."""


class QueryParams:
    """Query parameters by name; an empty value counts as not given."""

    def __init__(self, values: Mapping[str, str]) -> None:
        self._values = values

    def text(self, name: str, default: str = "") -> str:
        """Return a text; zero characters are refused because no database accepts them."""
        value = self._values.get(name, "").strip()
        if "\0" in value:
            raise RequestError(
                f"'{name}' holds a zero character, a text is expected: remove that character."
            )
        return value or default

    def choice(self, name: str, choices: Iterable[str], default: str = "") -> str:
        """Return one of several texts."""
        value, known = self.text(name, default), list(choices)
        if value and value not in known:
            hint = suggestion(value, known) if known else "remove it, none exists."
            raise RequestError(f"'{name}' is '{truncated(value)}', which is not valid: {hint}")
        return value

    def member(self, name: str, kind: type[E], default: E) -> E:
        """Return a member of an enumeration."""
        return kind(self.choice(name, list(kind), default))

    def integer(self, name: str, low: int = 0, high: int = LARGEST) -> int | None:
        """Return an integer within bounds, None if it is not given."""
        value = self.text(name)
        if not value:
            return None
        digits = value.removeprefix("-")
        if digits.isascii() and digits.isdigit() and len(digits) < 20 and low <= int(value) <= high:
            return int(value)
        raise RequestError(
            f"'{name}' is '{truncated(value)}', expected is a whole number of {low} to {high}: "
            f"write one."
        )

    def position(self, name: str, text: bool) -> tuple[float | str | None, int] | None:
        """Return the position (sort value, row id) after or before which a page starts.

        ``text`` says whether the sort column contains text or numbers.
        """
        value = self.text(name)
        if not value:
            return None
        try:
            found = json.loads(value)
        except (ValueError, RecursionError):
            found = None
        match found:
            case [None | str() | int() | float() as key, int(row)] if _fits(key) and _fits(row):
                if key is None or isinstance(key, str) is text:
                    return key, row
        raise RequestError(f"'{name}' names no place in the list: start from its first page.")

    def conditions(self) -> dict[str, object]:
        """Return the conditions of ``where`` and ``width``, such as model.width=32."""
        found = dict(_condition(word) for word in self.text("where").split())
        width = self.integer("width", low=1)
        return found if width is None else {**found, "model.width": width}

    def filter(self, *environments: str) -> Filter:
        """Return the filter of the requested configurations."""
        return Filter(environments, (), self.conditions())


def _fits(value: object) -> bool:
    if isinstance(value, bool) or (isinstance(value, str) and "\0" in value):
        return False
    return not isinstance(value, int | float) or (math.isfinite(value) and abs(value) < 2**63)


def _condition(word: str) -> tuple[str, object]:
    found = read_condition(word)
    if found is None:
        raise RequestError(
            f"'where' holds '{truncated(word)}', conditions PATH=VALUE are expected: "
            f"write for instance policy.form=dual."
        )
    return found


def truncated(text: str, length: int = 60) -> str:
    """Return the start of a text with unprintable characters replaced."""
    shown = "".join(letter if letter.isprintable() else "?" for letter in text)
    return shown if len(shown) <= length else f"{shown[: length - 1]}…"
